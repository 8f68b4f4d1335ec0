# Each target sets up .venv by itself; nothing is installed outside it.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: demo test check bench

demo: .venv/installed  ## simulate, pack, train, embed, index, evaluate, report, locate: at most six minutes on two cores
	$(BIN)/python jobs/demo.py --out runs/demo

test: .venv/installed
	$(BIN)/pytest

check: .venv/installed
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

bench: .venv/installed
	for name in simulate shards streaming evaluate index train_step damage chaos; do $(BIN)/python benchmarks/$$name.py || exit 1; done
# benchmarks/ablation.py (hours) and benchmarks/locate.py (minutes) take a folder of imagery, benchmarks/serve.py a trained
# network and its index: they are called by hand

.venv/installed: pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and f"found Python {sys.version}; expected 3.11 or later; say make PYTHON=python3.11")'
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	touch $@
