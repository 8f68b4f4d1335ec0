"""Figures for a paper: every one that there is data for, embedded fonts, the same bytes each time."""

import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

from test_report import TOWN, jpeg
from test_report_map import A, B, query
from test_report_sections import full, merged

from pipeline.figures import write_figures
from pipeline.report_inputs import Format

VIEWS = tuple({"task": "drone->satellite", "views": n, "r1": 0.5, "r1_low": 0.25, "r1_high": 0.75} for n in (1, 2))
NAMES = {
    "recall", "scores", "views", "parts", "groups-altitude_m", "view-gap-drone-satellite", "map-drone-satellite",
    "retrieval-drone-satellite", "multi-query-drone-satellite",
}  # fmt: skip
AGAIN = "from test_figures import write; import sys; write(sys.argv[1])"


def write(folder: str, formats: tuple[Format, ...] = ("pdf",)) -> list[str]:
    placed = {name: query("a", A, "b", B)[name] for name in ("lat", "lon", "answer_lat", "answer_lon", "distance_m")}
    found = full([row | placed for row in TOWN], [merged(row["location"], 1) for row in TOWN])
    return write_figures(replace(found, views=VIEWS), lambda keys: dict.fromkeys(keys, jpeg("olive")), folder, formats)


def test_every_figure_is_written_in_both_formats_and_another_process_writes_the_same_bytes(tmp_path: Path) -> None:
    assert set(write(str(tmp_path / "one"), ("png", "pdf"))) == NAMES
    files = sorted(path.name for path in (tmp_path / "one").iterdir())
    assert files == sorted(f"{name}.{kind}" for name in NAMES for kind in ("png", "pdf"))
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path]),
        "PYTHONHASHSEED": "7",
    }
    subprocess.run([sys.executable, "-c", AGAIN, str(tmp_path / "two")], check=True, env=environment)
    for path in (tmp_path / "two").iterdir():
        assert (tmp_path / "one" / path.name).read_bytes() == path.read_bytes(), path.name
    data = (tmp_path / "one" / "recall.pdf").read_bytes()
    assert b"/CIDFontType2" in data  # TrueType, embedded
    assert b"/Type3" not in data
    assert not re.search(rb"/(Creation|Mod)Date", data)


def test_without_pictures_there_are_no_figures_of_pictures(tmp_path: Path) -> None:
    found = full(TOWN, [merged(row["location"], 1) for row in TOWN])
    names = write_figures(found, lambda keys: {}, str(tmp_path), ("png",))
    assert names == ["recall", "scores", "parts", "groups-altitude_m", "view-gap-drone-satellite"]


def test_merged_queries_alone_have_a_recall_curve(tmp_path: Path) -> None:
    found = full(TOWN, [merged(row["location"], 1) for row in TOWN])
    alone = replace(found, metrics=found.metrics[1:], groups=(), parts=(), gaps=())
    assert write_figures(alone, lambda keys: {}, str(tmp_path), ("pdf",)) == ["recall"]
