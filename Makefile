# Each target sets up .venv by itself; nothing is installed outside it.
PYTHON ?= python3
BIN := .venv/bin
# Processes that share the tests, each with a Ray; 0: this one alone.
TEST_PROCESSES ?= 2
# Compiled modules are kept: else each process of the tests compiles them anew.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help install demo region test test-fast check format bench chaos

help:  ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## /{printf "make %-10s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

install: .venv/installed  ## install the project and its pinned dependencies into .venv

demo: .venv/installed  ## the complete road on simulated flights: at most six minutes on two cores
	$(BIN)/python jobs/demo.py --out runs/demo

SAMPLE := runs/region

region: .venv/installed  ## a made-up town as a map, adapted to; photos of another day located on it: five minutes on two cores
	$(BIN)/pvda town --out $(SAMPLE)/town --side 500 --resolution 0.5
	$(BIN)/pvda fly --mosaic $(SAMPLE)/town/another_day.tif --surface $(SAMPLE)/town/surface.tif --no-relight --out $(SAMPLE)/flight --photos 12
	$(BIN)/pvda adapt --mosaic $(SAMPLE)/town/map.tif --surface $(SAMPLE)/town/surface.tif --out $(SAMPLE)/region --minutes 1 --checks 20
	$(BIN)/pvda locate --index $(SAMPLE)/region/index --out $(SAMPLE)/where.geojson --page $(SAMPLE)/where.html $(SAMPLE)/flight/photos

test: .venv/installed  ## all tests, shared by two processes
	$(BIN)/pytest -n $(TEST_PROCESSES) --no-loadscope-reorder

test-fast: .venv/installed  ## the tests without Ray, training, fuzzing and browsers: a minute
	$(BIN)/pytest -n $(TEST_PROCESSES) -m "not slow"

check: .venv/installed  ## formatting, lint and types
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

format: .venv/installed  ## format the code and repair what the linter can
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

bench: .venv/installed  ## the benchmarks that need no data: half an hour
	for name in simulate shards streaming evaluate index train_step damage; do $(BIN)/python benchmarks/$$name.py || exit 1; done
# benchmarks/ablation.py (hours) and benchmarks/locate.py (minutes) take a folder of imagery, benchmarks/serve.py a trained
# network and its index: they are called by hand

chaos: .venv/installed  ## the fault campaign over every stage: about an hour
	$(BIN)/python -m tests.chaos

.venv/installed: pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and f"found Python {sys.version}; expected 3.11 or later; run make PYTHON=python3.11")'
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	touch $@
