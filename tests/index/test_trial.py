"""A plan is tried on a sample before it is built, and the next one taken where it fails."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from pipeline.index.build import build_index, plan_only
from pipeline.index.metadata import IndexMetadata
from pipeline.index.planning import plan, planner, trial
from pipeline.index.planning.plan import GallerySpec, candidate_plans
from pipeline.index.planning.trial import trial_rows, try_plan
from pipeline.index.settings import IndexSettings
from tests.index.index_tables import clustered, write_table_part

pytestmark = pytest.mark.slow

ROWS, DIMENSION = 1_800, 32
FIRST = "HNSW32,SQ8"
"The plan that the planner tries first for such a gallery."


@pytest.fixture(scope="module")
def tight(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Clusters so tight that the steps of 8-bit codes are as long as the ways between neighbours:
    a graph over such codes, the planner's first choice, finds .41 however hard it searches, and
    lists .55.
    """
    folder = tmp_path_factory.mktemp("tight")
    for number in range(3):
        vectors = clustered(ROWS // 3, DIMENSION, number, noise=0.05)
        write_table_part(folder, number, vectors)
    write_table_part(folder, 0, clustered(64, DIMENSION, 9, noise=0.05), "query", "drone")
    return str(folder)


@pytest.fixture
def few_are_many(monkeypatch: pytest.MonkeyPatch) -> None:
    """The rows of the tests are planned for as a large gallery's are."""
    monkeypatch.setattr(plan, "EXACT_ROWS", 100)
    monkeypatch.setattr(trial, "MIN_TRIAL_ROWS", 1_200)


def settings(table: str, out: Path, **changes: Any) -> IndexSettings:
    given: dict[str, Any] = {"table": table, "out": str(out), "target_recall": 0.95} | changes
    return IndexSettings(**given)


def built(table: str, out: Path, **changes: Any) -> IndexMetadata:
    return build_index(settings(table, out, split="gallery", **changes))


def test_build_takes_the_next_plan_where_the_first_fails(
    tight: str, tmp_path: Path, few_are_many: None, capsys: pytest.CaptureFixture[str]
) -> None:
    first = candidate_plans(
        GallerySpec(rows=ROWS, dimension=DIMENSION, budget=4e9, target_recall=0.95)
    )[0]
    assert (first.factory, first.refine) == (FIRST, "none")
    metadata = built(tight, tmp_path / "index")
    assert metadata.factory != FIRST
    assert metadata.measured["recall_at_10"] >= 0.95
    why = metadata.measured["rejected"][FIRST]
    assert "at most (" in why
    assert "below 0.95" in why
    assert f"rejected {FIRST}: {why}" in capsys.readouterr().err


def test_build_takes_the_next_plan_where_the_built_one_fails(
    tight: str, tmp_path: Path, few_are_many: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The trial of the first plan is made to promise what the index then does not reach."""

    def promising(candidate: Any, gallery: GallerySpec, sample: Any) -> Any:
        tried = try_plan(candidate, gallery, sample)
        if candidate.factory != FIRST:
            return tried
        return replace(tried, points=(replace(tried.points[0], recall=0.99),))

    monkeypatch.setattr(planner, "try_plan", promising)
    metadata = built(tight, tmp_path / "index")
    assert "once built, below 0.95" in metadata.measured["rejected"][FIRST]
    assert metadata.measured["recall_at_10"] >= 0.95


def test_killed_build_resumes_without_another_trial(
    tight: str, tmp_path: Path, few_are_many: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(*arguments: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("pipeline.index.build.finish_index", killed)
        with pytest.raises(KeyboardInterrupt):
            built(tight, tmp_path / "index")
    monkeypatch.setattr(planner, "try_plan", killed)
    assert built(tight, tmp_path / "index").measured["recall_at_10"] >= 0.95


def test_dry_run_prints_the_front_and_writes_nothing(
    tight: str, tmp_path: Path, few_are_many: None, capsys: pytest.CaptureFixture[str]
) -> None:
    given = settings(tight, tmp_path / "index", p99_ms=1e4, build_minutes=1e3, dry_run=True)
    decision = plan_only(given)
    assert not (tmp_path / "index").exists()
    printed = capsys.readouterr().out
    assert "p99 ms" in printed
    assert "bytes a row" in printed
    assert all(f"rejected {label}: " in printed for label in decision.rejected)
    names = {row["plan"] for row in decision.front}
    assert len(names) > 1
    assert decision.plan.factory in {name.split(" ")[0] for name in names}


def test_trial_rows_fit_the_memory() -> None:
    gallery = GallerySpec(rows=10**6, dimension=2048, budget=4e9, target_recall=0.95)
    assert trial_rows(gallery) == 32_768
    assert trial_rows(replace(gallery, budget=4e8)) == 6_103
    assert trial_rows(replace(gallery, rows=500)) == 500
