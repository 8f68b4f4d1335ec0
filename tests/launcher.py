"""Runs the real jobs from a process that has imported their libraries already: one begins in
milliseconds, not in seconds.

The server forks; each child is a session of its own and does what `python jobs/NAME.py ARGUMENTS`
would do.
"""

import atexit
import importlib
import json
import os
import runpy
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
PATH = (str(Path(__file__).parent / "chaos" / "hook"), str(ROOT))
"Of every Python process: where the faults of the storage are, and the project."
LIBRARIES = (
    "torch",
    "ray",
    "ray.train.torch",
    "faiss",
    "pyarrow.parquet",
    "tensorboard",
    "PIL.Image",
    "simplejpeg",
)
PATIENCE = 300.0
"Seconds that a job may take on a busy machine."
JOBS = ("simulate", "make_shards", "train", "embed_gallery", "build_index", "evaluate")


@dataclass(frozen=True, kw_only=True)
class Ended:
    """How a job ended."""

    code: int | None
    "Exit code, negative for a signal; None where it was stopped for taking too long."
    seconds: float
    said: str
    "Standard output and error together."


class Job:
    """A job that runs."""

    def __init__(self, pid: int, log: Path) -> None:
        self.pid, self._log, self._began = pid, log, time.monotonic()
        self.code: int | None = None
        "Once it is over."

    @property
    def seconds(self) -> float:
        return time.monotonic() - self._began

    def wait(self, until: float) -> bool:
        """Whether it is over, at the latest when it has run for `until` seconds."""
        while self.code is None and self.seconds < until:
            time.sleep(0.005)
        return self.code is not None

    def end(self, patience: float = PATIENCE) -> Ended:
        """Wait for its end, or stop it when it has run for `patience` seconds."""
        over, took = self.wait(patience), self.seconds
        with suppress(ProcessLookupError):  # what it has left running too
            os.killpg(self.pid, signal.SIGKILL)
        self.wait(patience + 30)
        said = self._log.read_text(errors="replace")
        return Ended(code=self.code if over else None, seconds=took, said=said)


class Launcher:
    """The server, and the jobs that it runs. `environment` holds for all of them."""

    def __init__(self, scratch: Path, environment: Mapping[str, str]) -> None:
        self._log, self._jobs = scratch / "job.log", dict[int, Job]()
        self._server = subprocess.Popen(
            [sys.executable, "-m", "tests.launcher"],
            cwd=ROOT,
            text=True,
            bufsize=1,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ | environment | {"PYTHONPATH": os.pathsep.join(PATH)},
        )
        self._started: list[int] = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def start(self, name: str, arguments: Sequence[str], **environment: str) -> Job:
        assert self._server.stdin is not None
        known = len(self._started)
        order = {
            "name": name,
            "arguments": list(arguments),
            "environment": environment,
            "log": str(self._log),
        }
        self._server.stdin.write(json.dumps(order) + "\n")
        while len(self._started) == known:
            if self._server.poll() is not None:
                raise RuntimeError("the server that starts jobs has ended")
            time.sleep(0.002)
        return self._jobs[self._started[-1]]

    def close(self) -> None:
        assert self._server.stdin is not None
        self._server.stdin.close()
        self._server.wait(30)
        self._reader.join()
        assert self._server.stdout is not None
        self._server.stdout.close()

    def _read(self) -> None:
        assert self._server.stdout is not None
        for line in self._server.stdout:
            told: dict[str, Any] = json.loads(line)
            if "code" in told:
                self._jobs[told["pid"]].code = told["code"]
            else:
                self._jobs[told["pid"]] = Job(told["pid"], self._log)
                self._started.append(told["pid"])


def serve() -> dict[str, Any]:
    """Fork a child per order; returns in the children alone, with the order, and ends the server
    when its input does.
    """
    for name in (*LIBRARIES, *(f"jobs.{job}" for job in JOBS)):
        importlib.import_module(name)
    wanted, waiting = b"", True
    while waiting:
        with suppress(ChildProcessError):
            while (over := os.waitpid(-1, os.WNOHANG))[0]:
                print(
                    json.dumps({"pid": over[0], "code": os.waitstatus_to_exitcode(over[1])}),
                    flush=True,
                )
        if not select.select([0], [], [], 0.01)[0]:
            continue
        more = os.read(0, 1 << 16)
        waiting = bool(more)
        *orders, wanted = (wanted + more).split(b"\n")
        for order in map(json.loads, orders):
            if not (pid := os.fork()):
                return dict(order)
            print(json.dumps({"pid": pid}), flush=True)
    sys.exit(0)


def become(order: dict[str, Any]) -> None:
    """Be the job that an order names."""
    os.setsid()
    log = os.open(order["log"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for number in (1, 2):
        os.dup2(log, number)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.environ.update(order["environment"])
    path = ROOT / "jobs" / f"{order['name']}.py"
    sys.argv = [str(path), *order["arguments"]]
    code: Any = 1
    try:
        runpy.run_path(str(path), run_name="__main__")
        code = 0
    except SystemExit as asked:
        code = asked.code
    except BaseException:
        sys.excepthook(*sys.exc_info())
    # As Python ends, but for taking every imported module apart, which costs seconds where all of
    # its memory is shared.
    threading._shutdown()  # type: ignore[attr-defined]
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code or 0)


if __name__ == "__main__":
    become(serve())
