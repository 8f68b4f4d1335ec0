"""Every job as a stranger calls it: help, the whole road by command lines, again on finished output, and wrong calls."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import faiss
import pytest

ROOT = Path(__file__).parent.parent
JOBS = [
    "simulate", "make_shards", "train", "embed_gallery", "build_index", "evaluate", "import_weights", "calibrate", "locate",
    "demo",
]  # fmt: skip


def call(job: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(ROOT / "jobs" / f"{job}.py"), *map(str, arguments)]
    # An environment of its own: without one the new process is given the C library's, which others of our threads may be
    # writing, and once in thousands of calls could not be started (EFAULT).
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False, env=dict(os.environ))


@pytest.fixture(scope="module")
def both_cores() -> Iterator[ThreadPoolExecutor]:
    """Calls that have nothing to do with each other are made by twos: most of each is Python's start."""
    with ThreadPoolExecutor(2) as pool:
        yield pool


@pytest.fixture(scope="module")
def helped(both_cores: ThreadPoolExecutor) -> Mapping[str, "Future[subprocess.CompletedProcess[str]]"]:
    """Every job's answer to --help."""
    return {job: both_cores.submit(call, job, "--help") for job in JOBS}


@pytest.mark.parametrize("job", JOBS)
def test_every_job_has_help(helped: Mapping[str, "Future[subprocess.CompletedProcess[str]]"], job: str) -> None:
    done = helped[job].result()
    assert done.returncode == 0
    assert "--out" in done.stdout


def test_every_job_runs_as_a_module_too() -> None:
    command = [sys.executable, "-m", "jobs.make_shards", "--help"]
    assert subprocess.run(command, capture_output=True, cwd=ROOT, check=False).returncode == 0


WRONG: list[tuple[str, list[str], str]] = [
    ("make_shards", ["--source", "university1652", "--root", "{}/nowhere", "--out", "{}/o"], "no folder"),
    ("make_shards", ["--source", "university1652", "--root", "{}", "--out", "{}/o"], "no images below"),
    ("make_shards", ["--root", "{}", "--out", "{}/o"], "--source is missing, expected one of: university1652"),
    ("make_shards", ["--verify", "--out", "{}"], "not a finished set of shards"),
    ("make_shards", ["--export", "{}/x.parquet", "--out", "{}"], "not a finished set of shards"),
    ("make_shards", ["--source", "photos", "--tile-m", "3", "--root", "{}", "--out", "{}/o"], "--tile-m"),
    ("make_shards", ["--source", "flickr", "--root", "{}", "--out", "{}/o"], "expected one of: university1652"),
    ("train", ["papr", "--shards", "{}", "--out", "{}/o"], "unknown recipe 'papr'"),
    ("train", ["smoke", "--shards", "{}", "--out", "{}/o"], "not a finished set of shards"),
    ("embed_gallery", ["--shards", "{}", "--checkpoint", "{}/none.pt", "--out", "{}/o"], "no checkpoint at"),
    ("import_weights", ["--torchvision", "{}/none.pth", "--out", "{}/o"], "no weights at"),
    ("import_weights", ["--lpn", __file__, "--out", "{}/o"], "is no state dict"),
    ("import_weights", ["--out", "{}/o"], "neither of --torchvision and --lpn"),
    ("build_index", ["--table", "{}", "--out", "{}/o"], "no feature table at"),
    ("build_index", ["--extend", "--table", "{}", "--out", "{}/o"], "no index at"),
    ("build_index", ["--remove", "0839", "--out", "{}/o"], "no index at"),
    ("build_index", ["--verify", "--out", "{}/o"], "no index at"),
    ("evaluate", ["--table", "{}", "--out", "{}/o"], "no feature table at"),
    ("locate", ["--checkpoint", "{}/c.pt", "--index", "{}", "--out", "{}/o", "{}/gone.jpg"], "no photo or folder at"),
    ("locate", ["--checkpoint", "{}/c.pt", "--index", "{}", "--out", "{}/o", "--near", "95", "0", "9", "{}"], "latitude 95"),
    ("calibrate", ["--checkpoint", "{}/c.pt", "--shards", "{}", "--index", "{}"], "no index at"),
    ("simulate", ["--out", "{}/o", "--train-locations", "1", "--test-locations", "1", "--distractors", "0",
                  "--textures", "{}/nowhere"], "nowhere"),
    ("make_shards", ["--root", "{}", "--out", "{}/o", "--source", "university1652", "--no-such-flag"], "--no-such-flag"),
]  # fmt: skip


@pytest.fixture(scope="module")
def refused(
    both_cores: ThreadPoolExecutor, tmp_path_factory: pytest.TempPathFactory
) -> Sequence[tuple[Path, "Future[subprocess.CompletedProcess[str]]"]]:
    """The answers to the wrong calls, each with the folder that it was made in."""
    folders = [tmp_path_factory.mktemp("wrong") for _ in WRONG]
    return [
        (folder, both_cores.submit(call, job, *(argument.format(folder) for argument in arguments)))
        for folder, (job, arguments, _) in zip(folders, WRONG, strict=True)
    ]


@pytest.mark.parametrize("number", range(len(WRONG)), ids=[f"{job}: {said}" for job, _, said in WRONG])
def test_a_wrong_call_gets_a_sentence_and_exit_code_2(
    refused: Sequence[tuple[Path, "Future[subprocess.CompletedProcess[str]]"]], number: int
) -> None:
    folder, answer = refused[number]
    done = answer.result()
    assert done.returncode == 2
    assert WRONG[number][2] in done.stderr
    assert "Traceback" not in done.stderr
    assert not (folder / "o").exists()


def test_the_road_by_command_lines_and_again(
    tmp_path: Path, tiny_shards: str, tiny_world: Path, ray_address: str
) -> None:
    """embed, index and evaluate after a training of two steps; then each again, which does nothing and says so."""
    run, table, index, out = (tmp_path / name for name in ("run", "table", "index", "evaluation"))
    small = ("--epochs", 1, "--batch-size", 3, "--part-dim", 16, "--workers", 0)
    calls: list[tuple[str, list[object]]] = [
        (
            "make_shards",
            ["--source", "university1652", "--root", tiny_world, "--out", tiny_shards, "--samples-per-shard", 8],
        ),
        ("train", ["smoke", "--shards", tiny_shards, "--out", run, *small]),
        ("embed_gallery", ["--shards", tiny_shards, "--checkpoint", run / "last.pt", "--out", table]),
        ("build_index", ["--table", table, "--out", index, "--split", "gallery", "--view", "satellite"]),
        ("evaluate", ["--table", table, "--out", out, "--shards", tiny_shards, "--run", run]),
    ]
    for job, arguments in calls:
        done = call(job, *arguments)
        assert done.returncode == 0, done.stderr
    for job, arguments in calls:
        done = call(job, *arguments)
        assert done.returncode == 0, done.stderr
        assert "nothing to do" in done.stderr
    assert faiss.read_index(str(index / "index.faiss")).ntotal == 5
    metrics = json.loads((out / "metrics.json").read_text())
    assert [(row["task"], row["multi_query"]) for row in metrics] == [
        ("drone->satellite", False), ("satellite->drone", False), ("drone->satellite", True),
    ]  # fmt: skip
    assert (metrics[0]["queries"], metrics[0]["gallery"]) == (9, 5)
    assert "data:image/webp" in (out / "report.html").read_text()
    photos = tiny_world / "test" / "query_drone"
    near = ("--near", -46.5, 8, 1e8)  # half-way round the earth, and a photo behind it
    given = ("--checkpoint", run / "last.pt", "--index", index, "--out", tmp_path / "o.geojson")
    done = call("locate", *given, *near, photos)
    assert done.returncode == 0, done.stderr
    assert len(json.loads((tmp_path / "o.geojson").read_text())["features"]) == 9
    pair = ("--queries", table, "--gallery", table, "--query-view", "drone", "--gallery-view", "satellite")
    done = call("evaluate", *pair, "--out", tmp_path / "pair", "--multi-query", "--protocol", "queried-only")
    assert done.returncode == 0, done.stderr
    other = call("train", "smoke", "--shards", tiny_shards, "--out", tmp_path / "run2", *small, "--seed", 5)
    assert other.returncode == 0, other.stderr
    mixed = call("embed_gallery", "--shards", tiny_shards, "--checkpoint", tmp_path / "run2/last.pt", "--out", table)
    assert mixed.returncode == 2
    assert "choose another --out" in mixed.stderr
