"""Ctrl-C and SIGTERM in the middle of the work: one sentence, nothing left running, and the same
command goes on.

Most cases wait for `PVDA_INTERRUPTS=all`: each of them starts a Ray of its own, twice.
"""

import os
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from jobs import STOPPED
from jobs.training.recipes.pvda import smoke
from model.checkpoint import Checkpoint, dumps
from model.pvda import FeatureEncoder
from tests.launcher import Launcher

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
ALL = os.environ.get("PVDA_INTERRUPTS") == "all"
MARK = "PVDA_INTERRUPTED"
BEGINS, ENDS, LINGERS = 120.0, 40.0, 20.0
"""Seconds until the work has begun, until the job has ended, until the last of Ray's processes has
noticed: on a busy machine."""

JOBS = {  # the command; what there is, below the folder, once its work has begun
    "make_shards": (
        "--source photos --root {photos} --out {out} --samples-per-shard 5",
        "out/*.tar",
    ),
    "make_shards here": (
        "--source photos --root {photos} --out {out} --samples-per-shard 5 --workers 0",
        "out/*.tar",
    ),
    "train": (
        "smoke --shards {shards} --out {out} --batch-size 2 --epochs 12",
        "out/metrics.jsonl",
    ),
    "train here": (
        "smoke --shards {shards} --out {out} --batch-size 2 --epochs 12 --workers 0",
        "out/metrics.jsonl",
    ),
    "simulate": (
        "--out {out} --train-locations 30 --test-locations 1 --distractors 0 --views 3 --size 64",
        "out/.parts/0*.json",
    ),
    "embed_gallery": ("--shards {packed} --checkpoint {net} --out {out}", "out/*.parquet"),
    "build_index": ("--table {table} --out {out} --factory IVF16,Flat", "out/_building/*"),
    "evaluate": (
        "--table {both} --shards {shards} --out {out} --figures png pdf",
        "said:drone->satellite",
    ),
    "locate": (
        "--checkpoint {net} --index {index} --out {out}/a.geojson {photos}",
        "said:not calibrated",
    ),
}
NORMALLY = [("make_shards here", signal.SIGINT, True), ("train here", signal.SIGTERM, False)]
CASES = [
    (job, number, group)
    for job in JOBS
    for number, group in ((signal.SIGINT, True), (signal.SIGINT, False), (signal.SIGTERM, False))
]
Caller = Callable[..., "subprocess.Popen[bytes]"]


@pytest.fixture(scope="module", autouse=True)
def _hearing_ctrl_c() -> Iterator[None]:
    """What runs in a shell's background has Ctrl-C ignored, and so has all that it starts."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="module")
def things(tmp_path_factory: pytest.TempPathFactory, tiny_shards: str) -> dict[str, Path]:
    """What the jobs take. Work for seconds, not for minutes."""
    folder = tmp_path_factory.mktemp("interrupt")
    rng = np.random.default_rng(0)
    for place in range(200):
        (folder / "photos" / f"{place:04d}").mkdir(parents=True)
        for view in range(4):
            image = Image.fromarray(rng.integers(0, 255, (32, 32, 3), dtype=np.uint8))
            image.save(folder / "photos" / f"{place:04d}" / f"{view}.jpg")
    network = smoke().network
    torch.manual_seed(0)
    state = {"modules": {"encoder": FeatureEncoder(network).state_dict()}}
    held = Checkpoint(
        network=network, recipe={"name": "made"}, locations=[], epoch=0, history=[], state=state
    )
    (folder / "net.pt").write_bytes(dumps(held))
    return {
        "photos": folder / "photos",
        "net": folder / "net.pt",
        "shards": Path(tiny_shards),
        "folder": folder,
    }


def prepared(things: dict[str, Path], wanted: str) -> Path:
    """A shard set, table or index of the photos, made by the jobs when it is first asked for."""
    made = things["folder"] / wanted
    if not made.exists():
        steps = {
            "packed": (
                "make_shards",
                "--source photos --root {photos} --out {packed} --samples-per-shard 5 --workers 0",
            ),
            "table": ("embed_gallery", "--shards {packed} --checkpoint {net} --out {table}"),
            "both": ("embed_gallery", "--shards {shards} --checkpoint {net} --out {both}"),
            "index": ("build_index", "--table {table} --out {index} --factory Flat"),
        }
        job, words = steps[wanted]
        process, log = begin(job, told(words, things), made.with_suffix(".log"))
        assert process.wait() == 0, log.read_text()
    return made


def told(words: str, things: dict[str, Path]) -> list[str]:
    wanted = [name for name in ("packed", "table", "both", "index") if f"{{{name}}}" in words]
    known = {name: str(path) for name, path in things.items()}
    known |= {
        name: str(things["folder"] / name)
        if f"--out {{{name}}}" in words
        else str(prepared(things, name))
        for name in wanted
    }
    return words.format(**known).split()


def begin(
    job: str, words: list[str], log: Path, mark: str = ""
) -> tuple["subprocess.Popen[bytes]", Path]:
    """A job in its own session, with its own Ray, whose every process carries the mark."""
    environment = os.environ | {
        MARK: mark or uuid.uuid4().hex,
        "RAY_ADDRESS": "local",
        "PYTHONPATH": str(ROOT),
    }
    with log.open("wb") as stream:
        command = [sys.executable, str(ROOT / "jobs" / f"{job.split()[0]}.py"), *words]
        return subprocess.Popen(
            command, env=environment, stdout=stream, stderr=stream, start_new_session=True
        ), log


def running(mark: str) -> list[str]:
    """Processes that a job started, or these did."""
    found = []
    for entry in Path("/proc").iterdir():
        try:
            marked = (
                entry.name.isdigit()
                and f"{MARK}={mark}".encode() in (entry / "environ").read_bytes()
            )
            if marked and (entry / "stat").read_text().rpartition(")")[2].split()[0] != "Z":
                found.append((entry / "cmdline").read_bytes().replace(b"\0", b" ").decode()[:150])
        except OSError:
            continue
    return found


def wait_for(what: Callable[[], bool], seconds: float) -> bool:
    end = time.monotonic() + seconds
    while not (there := what()) and time.monotonic() < end:
        time.sleep(0.02)
    return there


@pytest.mark.parametrize(("job", "number", "group"), CASES if ALL else NORMALLY)
def test_job_stopped_leaves_nothing_running_and_resumes(
    job: str,
    number: signal.Signals,
    group: bool,
    things: dict[str, Path],
    tmp_path: Path,
    prepared: Launcher,
) -> None:
    words, begun = JOBS[job]
    things = things | {"out": tmp_path / "out"}
    mark, arguments = uuid.uuid4().hex, told(words, things)
    process, log = begin(job, arguments, tmp_path / "log", mark)
    try:
        said = begun.partition("said:")[2].encode()

        def at_work() -> bool:
            return process.poll() is not None or (
                said in log.read_bytes() if said else any(tmp_path.glob(begun))
            )

        assert wait_for(at_work, BEGINS), log.read_text()
        assert process.poll() is None, f"it was too quick to be interrupted: {log.read_text()}"
        (os.killpg if group else os.kill)(process.pid, number)
        assert process.wait(ENDS) == 128 + number, log.read_text()
    finally:
        process.kill()
        process.wait()
    assert log.read_text().count(STOPPED) == 1
    assert "Traceback" not in log.read_text()
    assert wait_for(lambda: not running(mark), LINGERS), running(mark)
    ended = prepared.start(job.split()[0], arguments, RAY_ADDRESS="local").end()
    assert ended.code == 0, ended.output


def test_ctrl_c_during_imports_prints_stopped(tmp_path: Path) -> None:
    process, log = begin(
        "train",
        ["smoke", "--shards", str(tmp_path), "--out", str(tmp_path / "out")],
        tmp_path / "log",
    )
    loaded = Path(
        f"/proc/{process.pid}/maps"
    )  # before, Python starts, and is ended by Ctrl-C in its own words
    assert wait_for(lambda: "libtorch" in loaded.read_text(), BEGINS), log.read_text()
    process.send_signal(signal.SIGINT)
    code = process.wait(ENDS)
    # Python ends itself by the signal, or with 1 where some library's end has it forget that; 2: it
    # was quicker.
    assert code in (-signal.SIGINT, 1, 128 + signal.SIGINT, 2)
    assert STOPPED in log.read_text() or code == 2
    assert "Traceback" not in log.read_text()
