"""Runs jobs and benchmarks as processes forked from one that has imported their libraries.

A run starts within milliseconds instead of seconds. Each child is a session of its own and does
what `python FOLDER/NAME.py ARGUMENTS` would do.
"""

import ast
import atexit
import gc
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
from typing import Any, NoReturn

ROOT = Path(__file__).parents[1]
PYTHON_PATH = (str(Path(__file__).parent / "chaos" / "hook"), str(ROOT))
"PYTHONPATH of every process: the hook for storage faults, and the project."
LIBRARIES = (
    "torch._dynamo",  # the first optimizer imports it
    "ray.train.torch",
    "tensorboard",
    "scipy.io",
    "webdataset",
    "yaml",
)
"Libraries that jobs import within their work, besides those that their modules import."
TIMEOUT_S = 300.0
"Longest run of a job on a busy machine."


def hooked(fault: Path) -> dict[str, str]:
    """The environment of processes that meet the storage faults which the file `fault` asks for."""
    paths = [PYTHON_PATH[0], *filter(None, [os.environ.get("PYTHONPATH")])]
    return {"CHAOS": str(fault), "PYTHONPATH": os.pathsep.join(paths)}


@dataclass(frozen=True, kw_only=True)
class JobResult:
    """The outcome of a run."""

    code: int | None
    "Exit code, negative for a signal; None if the run was killed after its timeout."
    seconds: float
    output: str
    "Standard output and error together."


class RunningJob:
    """A run that was started."""

    def __init__(self, pid: int, log: Path) -> None:
        self.pid, self._log, self._start = pid, log, time.monotonic()
        self.code: int | None = None
        "Exit code, once the run has ended."

    @property
    def seconds(self) -> float:
        return time.monotonic() - self._start

    def wait(self, until: float) -> bool:
        """Wait until the run ends, at most until it has taken `until` seconds; whether it ended."""
        while self.code is None and self.seconds < until:
            time.sleep(0.005)
        return self.code is not None

    def end(self, timeout_s: float = TIMEOUT_S) -> JobResult:
        """Wait for the run's end, or kill it when it has taken `timeout_s`."""
        ended, seconds = self.wait(timeout_s), self.seconds
        with suppress(ProcessLookupError):  # processes that the run has left behind
            os.killpg(self.pid, signal.SIGKILL)
        self.wait(timeout_s + 30)
        output = self._log.read_text(errors="replace")
        return JobResult(code=self.code if ended else None, seconds=seconds, output=output)


class Launcher:
    """The server that forks, and its runs. `environment` applies to all of them."""

    def __init__(self, scratch: Path, environment: Mapping[str, str]) -> None:
        self._log, self._jobs = scratch / "job.log", dict[int, RunningJob]()
        self._server = subprocess.Popen(
            # By its module name: run as a file it would find tests/jobs as the package `jobs`.
            [sys.executable, "-m", "tests.launcher"],
            cwd=ROOT,
            text=True,
            bufsize=1,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ | environment | {"PYTHONPATH": os.pathsep.join(PYTHON_PATH)},
        )
        self._started: list[int] = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def start(
        self, name: str, arguments: Sequence[str], folder: str = "jobs", **environment: str
    ) -> RunningJob:
        """Run `FOLDER/NAME.py`; its log replaces that of the run before."""
        assert self._server.stdin is not None
        known = len(self._started)
        order = {
            "path": str(ROOT / folder / f"{name}.py"),
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
            event: dict[str, Any] = json.loads(line)
            if "code" in event:
                self._jobs[event["pid"]].code = event["code"]
            else:
                self._jobs[event["pid"]] = RunningJob(event["pid"], self._log)
                self._started.append(event["pid"])


def job_modules() -> list[str]:
    """The modules that the scripts of jobs/ import, those within their functions too."""
    return [
        node.module
        for script in sorted((ROOT / "jobs").glob("*.py"))
        for node in ast.walk(ast.parse(script.read_text()))
        if isinstance(node, ast.ImportFrom) and node.module
    ]


def serve() -> dict[str, Any]:
    """Fork a child per order read from stdin; returns in the children only, with their order.

    The server exits at the end of its input.
    """
    for name in (*LIBRARIES, *job_modules()):
        importlib.import_module(name)
    gc.freeze()  # else the children's collections of garbage copy the pages that they share
    buffer, is_open = b"", True
    while is_open:
        with suppress(ChildProcessError):
            while (ended := os.waitpid(-1, os.WNOHANG))[0]:
                code = os.waitstatus_to_exitcode(ended[1])
                print(json.dumps({"pid": ended[0], "code": code}), flush=True)
        if not select.select([0], [], [], 0.01)[0]:
            continue
        data = os.read(0, 1 << 16)
        is_open = bool(data)
        *orders, buffer = (buffer + data).split(b"\n")
        for order in map(json.loads, orders):
            if not (pid := os.fork()):
                return dict(order)
            print(json.dumps({"pid": pid}), flush=True)
    sys.exit(0)


def run_job(order: dict[str, Any]) -> NoReturn:
    """Run the script of an order in this process, and exit."""
    os.setsid()
    log = os.open(order["log"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for number in (1, 2):
        os.dup2(log, number)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    before = set(os.environ)
    os.environ.update(order["environment"])
    if "CHAOS" in order["environment"] and "CHAOS" not in before:
        hook = importlib.import_module("sitecustomize")  # of PYTHON_PATH; else it has done so
        hook.inject_faults(importlib.import_module("pipeline.core.storage"))
    run_script([order["path"], *order["arguments"]])


def run_script(words: list[str]) -> NoReturn:
    """As `python SCRIPT ARGUMENTS`, in this process."""
    sys.argv = words
    sys.path.insert(0, os.path.dirname(words[0]))
    code: Any = 1
    try:
        runpy.run_path(words[0], run_name="__main__")
        code = 0
    except SystemExit as exit_:
        code = exit_.code
    except BaseException:
        sys.excepthook(*sys.exc_info())
    # As Python ends, but without taking every imported module apart, which costs seconds because
    # the process shares all of its memory.
    threading._shutdown()  # type: ignore[attr-defined]
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code or 0)


if __name__ == "__main__":
    run_job(serve())
