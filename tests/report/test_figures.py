"""Figures of a paper: one for all data there is, embedded fonts, the same bytes each time."""

import re
from dataclasses import replace
from pathlib import Path

import pytest

from pipeline.report.figures import write_figures
from tests.report.test_error_map import A, B, query
from tests.report.test_page import TOWN, jpeg
from tests.report.test_sections import full, merged

pytestmark = pytest.mark.slow

VIEWS = tuple(
    {
        "task": "drone->satellite",
        "views": n,
        "queries": 4,
        "r1": 0.5,
        "r1_low": 0.25,
        "r1_high": 0.75,
    }
    for n in (1, 2)
)
NAMES = {
    "recall",
    "scores",
    "views",
    "parts",
    "groups-altitude_m",
    "view-gap-drone-satellite",
    "map-drone-satellite",
    "retrieval-drone-satellite",
    "multi-query-drone-satellite",
}


RESULTS = full(TOWN, [merged(row["location"], 1) for row in TOWN])


def test_write_figures_embeds_fonts_and_no_date(
    tmp_path: Path,
) -> None:
    positions = {
        name: query("a", A, "b", B)[name]
        for name in ("lat", "lon", "answer_lat", "answer_lon", "distance_m")
    }
    found = full(
        [row | positions for row in TOWN[:3]], [merged(row["location"], 1) for row in TOWN[:3]]
    )
    picture = jpeg("olive")
    names = write_figures(
        replace(found, views=VIEWS),
        lambda keys: dict.fromkeys(keys, picture),
        str(tmp_path),
        ("pdf",),
    )
    assert set(names) == NAMES
    assert {path.name for path in tmp_path.iterdir()} == {f"{name}.pdf" for name in NAMES}
    data = (tmp_path / "recall.pdf").read_bytes()
    assert b"/CIDFontType2" in data  # TrueType, embedded
    assert b"/Type3" not in data
    assert not re.search(rb"/(Creation|Mod)Date", data)


def test_write_figures_gives_the_same_bytes_in_any_formats(
    tmp_path: Path,
) -> None:
    """Without images there are no figures of hits and misses."""
    found = replace(RESULTS, groups=(), parts=())
    names = write_figures(found, lambda keys: {}, str(tmp_path / "both"), ("png", "pdf"))
    assert names == ["recall", "scores", "view-gap-drone-satellite"]
    assert len(list((tmp_path / "both").iterdir())) == 2 * len(names)
    assert write_figures(found, lambda keys: {}, str(tmp_path / "one"), ("pdf",)) == names
    for path in (tmp_path / "one").iterdir():
        assert (tmp_path / "both" / path.name).read_bytes() == path.read_bytes(), path.name


def test_write_figures_of_merged_queries_has_a_recall_curve(tmp_path: Path) -> None:
    alone = replace(RESULTS, metrics=RESULTS.metrics[1:], groups=(), parts=(), gaps=())
    assert write_figures(alone, lambda keys: {}, str(tmp_path), ("pdf",)) == ["recall"]
