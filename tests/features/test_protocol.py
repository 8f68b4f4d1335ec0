"""The whole evaluation against a loop over queries, written from METHOD.md's definitions alone, and
the official counts.

The loop has no blocks, bounds or ranks by counting: it scores, sorts and walks one query after the
other.
"""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.core.arrays import Floats
from pipeline.core.records import Split, View
from pipeline.features.part import PartFooter, PartRows, write_part
from pipeline.features.table import open_table
from pipeline.retrieval.metrics import Protocol
from pipeline.retrieval.ranking import BlockSizes
from pipeline.retrieval.tasks import Task, retrieve

Listed = list[tuple[str, Floats]]


def world(seed: int) -> tuple[Listed, Listed]:
    """Nine places as satellites, three of them distractors, and their UAV images: one place has 55,
    one query place has none in the gallery, and coarse coordinates make many scores equal."""
    rng = np.random.default_rng(seed)
    centres = rng.integers(-2, 3, (10, 6)).astype(float)
    centres[np.abs(centres).sum(axis=1) == 0] = 1

    def near(place: int) -> Floats:
        vector = centres[place] + rng.integers(-1, 2) * np.eye(6)[rng.integers(0, 2)]
        vector = vector if vector.any() else centres[place]
        return np.asarray(vector / np.linalg.norm(vector), np.float32)

    drone = [
        (f"{p:04d}", near(p))
        for p, count in enumerate([55, 54, 3, 1, 2, 54, 4])
        for _ in range(count)
    ]
    satellite = [
        (f"{p:04d}", near(p)) for p in (0, 1, 2, 3, 4, 5, 7, 8, 9)
    ]  # 0006 has no satellite image
    return drone, satellite


def table(folder: Path, drone: Listed, satellite: Listed) -> str:
    """As the test set has it: query and gallery rows of both views."""
    for split in (Split.QUERY, Split.GALLERY):
        for view, rows in ((View.DRONE, drone), (View.SATELLITE, satellite)):
            kept = [row for row in rows if split == Split.GALLERY or row[0] < "0007"]
            write_part(
                str(folder / f"{split}-{view}.parquet"),
                PartRows(
                    keys=[f"{split}-{view}-{i}" for i in range(len(kept))],
                    locations=[place for place, _ in kept],
                    views=[view] * len(kept),
                    splits=[split] * len(kept),
                    lats=[None] * len(kept),
                    lons=[None] * len(kept),
                    embeddings_BD=np.stack([vector for _, vector in kept]),
                ),
                PartFooter(fingerprint="f", shard_sha256=f"{split}{view}", rows=len(kept)),
            )
    return str(folder)


def by_hand(queries: Listed, gallery: Listed) -> dict[str, float]:
    """METHOD.md, "Evaluation protocol", one query after the other; ties against the query."""
    sums = dict.fromkeys(("r1", "r5", "r10", "r1p", "ap"), 0.0)
    top = round(0.01 * len(gallery))  # CMC[round(0.01 * N)]
    for place, vector in queries:
        scored = []
        for other, candidate in gallery:
            # The score that DESIGN.md fixes: components to multiples of 2^-26, summed exactly,
            # rounded to float32.
            terms = [
                float(np.rint(a * 2**26)) * float(np.rint(b * 2**26))
                for a, b in zip(vector, candidate, strict=True)
            ]
            scored.append((float(np.float32(math.fsum(terms) / 2**52)), other == place))
        scored.sort(key=lambda pair: (-pair[0], pair[1]))
        places = [r for r, (_, right) in enumerate(scored) if right]  # 0-based
        if not places:
            continue  # the official code skips it here and divides by all queries below
        for name, last in (("r1", 0), ("r5", 4), ("r10", 9), ("r1p", top)):
            sums[name] += places[0] <= last
        sums["ap"] += sum(
            ((i / r if r else 1) + (i + 1) / (r + 1)) / 2 for i, r in enumerate(places)
        ) / len(places)
    return {name: total / len(queries) for name, total in sums.items()}


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("protocol", ["full", "queried-only"])
def test_protocol_measures_equal_loop_over_queries(
    tmp_path: Path, seed: int, protocol: Protocol
) -> None:
    drone, satellite = world(seed)
    opened = open_table(table(tmp_path, drone, satellite))
    queries = {View.DRONE: drone, View.SATELLITE: [row for row in satellite if row[0] < "0007"]}
    galleries = {View.DRONE: drone, View.SATELLITE: satellite}
    for ask, show in ((View.DRONE, View.SATELLITE), (View.SATELLITE, View.DRONE)):
        asked, shown = queries[ask], galleries[show]
        if protocol == "queried-only":
            shown = [row for row in shown if row[0] in {place for place, _ in asked}]
        expected = by_hand(asked, shown)
        for cut in (BlockSizes(), BlockSizes(queries_in_memory=50, query_rows=7, gallery_rows=5)):
            found = retrieve(
                Task(query_view=ask, gallery_view=show), opened, opened, protocol, cut
            ).metrics
            assert {name: found[name] for name in expected} == pytest.approx(expected, abs=1e-12)
            assert (found["queries"], found["gallery"]) == (len(asked), len(shown))
            assert all(
                found[f"{name}_low"] <= found[name] <= found[f"{name}_high"] for name in expected
            )


def test_protocol_world_has_hard_cases() -> None:
    drone, satellite = world(0)
    counts = [sum(place == f"{p:04d}" for place, _ in drone) for p in range(7)]
    assert 55 in counts
    assert {place for place, _ in drone} - {place for place, _ in satellite} == {"0006"}
    assert {place for place, _ in satellite} - {place for place, _ in drone} == {
        "0007",
        "0008",
        "0009",
    }
    assert len({tuple(vector.tolist()) for _, vector in drone}) < len(drone) / 2


def test_protocol_multi_query_equals_loop_over_means(tmp_path: Path) -> None:
    drone, satellite = world(1)
    opened = open_table(table(tmp_path, drone, satellite))
    means: Listed = []
    for place in sorted({place for place, _ in drone}):
        rows: list[Any] = [
            np.rint(vector * 2.0**26) / 2**26 for other, vector in drone if other == place
        ]
        total = np.sum(rows, axis=0, dtype=np.float64)
        means.append((place, np.asarray(total / np.linalg.norm(total), np.float32)))
    task = Task(query_view=View.DRONE, gallery_view=View.SATELLITE, multi_query=True)
    found = retrieve(task, opened, opened).metrics
    expected = by_hand(means, satellite)
    assert {name: found[name] for name in expected} == pytest.approx(expected, abs=1e-12)
