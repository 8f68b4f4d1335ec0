"""Every job as a stranger calls it: help, the whole road by command lines, again on finished
output, and wrong calls.
"""

import json
import subprocess
import sys
from pathlib import Path

import faiss
import pytest

from tests.launcher import JobResult, Launcher

ROOT = Path(__file__).parents[2]
JOBS = [
    "simulate",
    "make_shards",
    "train",
    "embed_gallery",
    "build_index",
    "evaluate",
    "import_weights",
    "export_weights",
    "calibrate",
    "locate",
    "demo",
]


@pytest.mark.parametrize("job", JOBS)
def test_job_has_help(prepared: Launcher, job: str) -> None:
    ended = prepared.start(job, ["--help"]).end()
    assert ended.code == 0
    assert "--out" in ended.output


@pytest.mark.slow
def test_job_runs_as_a_module() -> None:
    command = [sys.executable, "-m", "jobs.make_shards", "--help"]
    assert subprocess.run(command, capture_output=True, cwd=ROOT, check=False).returncode == 0


WRONG: list[tuple[str, list[str], str]] = [
    (
        "make_shards",
        ["--source", "university1652", "--root", "{}/nowhere", "--out", "{}/o"],
        "no folder",
    ),
    (
        "make_shards",
        ["--source", "university1652", "--root", "{}", "--out", "{}/o"],
        "no images below",
    ),
    (
        "make_shards",
        ["--root", "{}", "--out", "{}/o"],
        "--source is missing, expected one of: university1652",
    ),
    ("make_shards", ["--verify", "--out", "{}"], "not a finished set of shards"),
    ("make_shards", ["--export", "{}/x.parquet", "--out", "{}"], "not a finished set of shards"),
    (
        "make_shards",
        ["--source", "photos", "--tile-m", "3", "--root", "{}", "--out", "{}/o"],
        "--tile-m",
    ),
    (
        "make_shards",
        ["--source", "flickr", "--root", "{}", "--out", "{}/o"],
        "expected one of: university1652",
    ),
    ("train", ["papr", "--shards", "{}", "--out", "{}/o"], "unknown recipe 'papr'"),
    ("train", ["smoke", "--shards", "{}", "--out", "{}/o"], "not a finished set of shards"),
    (
        "embed_gallery",
        ["--shards", "{}", "--checkpoint", "{}/none.pt", "--out", "{}/o"],
        "no checkpoint at",
    ),
    ("import_weights", ["--torchvision", "{}/none.pth", "--out", "{}/o"], "no weights at"),
    ("import_weights", ["--lpn", __file__, "--out", "{}/o"], "is no state dict"),
    ("import_weights", ["--out", "{}/o"], "none given, expected one of --torchvision"),
    (
        "export_weights",
        ["--checkpoint", "{}/none.pt", "--out", "{}/o.safetensors"],
        "no checkpoint at",
    ),
    ("export_weights", ["--checkpoint", "builtin", "--out", "{}/o.pt"], "a name that ends in"),
    ("build_index", ["--table", "{}", "--out", "{}/o"], "no feature table at"),
    ("build_index", ["--extend", "--table", "{}", "--out", "{}/o"], "no index at"),
    ("build_index", ["--remove", "0839", "--out", "{}/o"], "no index at"),
    ("build_index", ["--verify", "--out", "{}/o"], "no index at"),
    ("evaluate", ["--table", "{}", "--out", "{}/o"], "no feature table at"),
    (
        "locate",
        ["--checkpoint", "{}/c.pt", "--index", "{}", "--out", "{}/o", "{}/gone.jpg"],
        "no photo or folder at",
    ),
    (
        "locate",
        [
            "--checkpoint",
            "{}/c.pt",
            "--index",
            "{}",
            "--out",
            "{}/o",
            "--near",
            "95",
            "0",
            "9",
            "{}",
        ],
        "latitude 95",
    ),
    ("calibrate", ["--checkpoint", "{}/c.pt", "--shards", "{}", "--index", "{}"], "no index at"),
    (
        "serve",
        ["--checkpoint", "{}/c.pt", "--index", "{}", "--host", "0.0.0.0"],
        "there is no token; give --token-file",
    ),
    (
        "simulate",
        [
            "--out",
            "{}/o",
            "--train-locations",
            "1",
            "--test-locations",
            "1",
            "--distractors",
            "0",
            "--textures",
            "{}/nowhere",
        ],
        "nowhere",
    ),
    (
        "make_shards",
        ["--root", "{}", "--out", "{}/o", "--source", "university1652", "--no-such-flag"],
        "--no-such-flag",
    ),
]


@pytest.mark.parametrize(
    ("job", "arguments", "said"), WRONG, ids=[f"{job}: {said}" for job, _, said in WRONG]
)
def test_job_wrong_call_exits_2_with_a_sentence(
    prepared: Launcher, tmp_path: Path, job: str, arguments: list[str], said: str
) -> None:
    ended = prepared.start(job, [argument.format(tmp_path) for argument in arguments]).end()
    assert ended.code == 2
    assert said in ended.output
    assert "Traceback" not in ended.output
    assert not (tmp_path / "o").exists()


def test_jobs_run_the_road_and_rerun_as_no_ops(
    prepared: Launcher, tmp_path: Path, tiny_shards: str, tiny_world: Path, ray_address: str
) -> None:
    """embed, index and evaluate after a training of two steps; then each again, which does nothing
    and says so.
    """

    def forked(job: str, *arguments: object) -> JobResult:
        return prepared.start(job, list(map(str, arguments)), RAY_ADDRESS=ray_address).end()

    run, table, index, out = (tmp_path / name for name in ("run", "table", "index", "evaluation"))
    small = ("--epochs", 1, "--batch-size", 3, "--part-dim", 16, "--workers", 0)
    calls: list[tuple[str, list[object]]] = [
        ("train", ["smoke", "--shards", tiny_shards, "--out", run, *small]),
        (
            "embed_gallery",
            ["--shards", tiny_shards, "--checkpoint", run / "last.pt", "--out", table],
        ),
        (
            "build_index",
            ["--table", table, "--out", index, "--split", "gallery", "--view", "satellite"],
        ),
        ("evaluate", ["--table", table, "--out", out, "--shards", tiny_shards, "--run", run]),
    ]
    for job, arguments in calls:
        ended = forked(job, *arguments)
        assert ended.code == 0, ended.output
    packing = [
        "--source",
        "university1652",
        "--root",
        tiny_world,
        "--out",
        tiny_shards,
        "--samples-per-shard",
        8,
    ]
    for job, arguments in [("make_shards", packing), *calls]:
        ended = forked(job, *arguments)
        assert ended.code == 0, ended.output
        assert "nothing to do" in ended.output
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
    assert forked("locate", *given, *near, photos).code == 0
    assert len(json.loads((tmp_path / "o.geojson").read_text())["features"]) == 9
    pair = (
        "--queries",
        table,
        "--gallery",
        table,
        "--query-view",
        "drone",
        "--gallery-view",
        "satellite",
    )
    ways = ("--multi-query", "--protocol", "queried-only")
    assert forked("evaluate", *pair, *ways, "--out", tmp_path / "pair").code == 0
    mixed = forked(
        "embed_gallery",
        "--shards",
        tiny_shards,
        "--checkpoint",
        "builtin",
        "--out",
        table,
    )
    assert mixed.code == 2
    assert "choose another --out" in mixed.output
