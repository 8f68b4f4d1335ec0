"""Processes on this machine: a job's descendants, Ray's workers and daemons, a cluster of our own.

Reads Linux's /proc; psutil would be one more dependency for three lines.
"""

import fcntl
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


def command_line(pid: int) -> str:
    """A process's command line; empty if it has ended."""
    try:
        return (
            Path(f"/proc/{pid}/cmdline")
            .read_bytes()
            .replace(b"\0", b" ")
            .decode(errors="replace")
            .strip()
        )
    except OSError:
        return ""


def descendants(pid: int) -> list[int]:
    """All descendants of a process."""
    children: dict[int, list[int]] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with suppress(OSError, IndexError):  # it has ended meanwhile
                parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
                children.setdefault(parent, []).append(int(entry.name))
    found, todo = list[int](), [pid]
    while todo:
        more = children.get(todo.pop(), [])
        found += more
        todo += more
    return sorted(found)


def busy_workers(pid: int) -> list[int]:
    """Ray's workers below a process that run a task or an actor.

    Ray's agents do not count: a node does not survive their death.
    """
    ignored = ("ray::IDLE", "ray::DashboardAgent", "ray::RuntimeEnvAgent")
    return [
        child
        for child in descendants(pid)
        if (name := command_line(child)).startswith("ray::") and not name.startswith(ignored)
    ]


def ray_daemons(pid: int) -> list[int]:
    """The raylet and the GCS below a process: a cluster does not survive their death."""
    return [
        child
        for child in descendants(pid)
        if any(word in command_line(child) for word in ("raylet/raylet", "gcs/gcs_server"))
    ]


def send_signal(pid: int, kind: signal.Signals) -> bool:
    """Send a signal; False if the process has ended."""
    try:
        os.kill(pid, kind)
    except ProcessLookupError:
        return False
    return True


@contextmanager
def one_start_of_ray() -> Iterator[None]:
    """Clusters of several test processes start one by one: two at once exceed their time."""
    with (Path(tempfile.gettempdir()) / "pvda-tests-ray.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


@contextmanager
def start_cluster(cpus: int, environment: dict[str, str]) -> Iterator[tuple[int, str]]:
    """A Ray cluster on this machine: the pid of the process above all of it, and its address.

    Tried three times: Ray gives its parts 30 s each, which a busy machine exceeds now and then.
    """
    with one_start_of_ray():
        for attempt in (1, 2, 3):
            head, address = _start_head(cpus, environment)
            if _wait_for_raylet(head):
                break
            _end(head)
            if attempt == 3:
                raise RuntimeError("Ray has not started")
    try:
        yield head.pid, address
    finally:
        _end(head)


def _start_head(cpus: int, environment: dict[str, str]) -> tuple["subprocess.Popen[bytes]", str]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    # With its dashboard: Ray Train asks it whether a controller is alive, and without it keeps the
    # resources of a dead one reserved.
    words = ["start", "--head", "--block", f"--port={port}", f"--num-cpus={cpus}"]
    ray = Path(sys.executable).with_name("ray")
    environment = os.environ | environment
    environment.pop("RAY_ADDRESS", None)  # of another cluster
    head = subprocess.Popen(
        [str(ray), *words, "--disable-usage-stats", "--node-ip-address=127.0.0.1"],
        env=environment,
        start_new_session=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    return head, f"127.0.0.1:{port}"


def _wait_for_raylet(head: "subprocess.Popen[bytes]") -> bool:
    """Whether it starts within a minute and a half."""
    deadline = time.monotonic() + 90
    while head.poll() is None and time.monotonic() < deadline:
        if any("raylet/raylet" in command_line(child) for child in descendants(head.pid)):
            return True
        time.sleep(0.1)
    return False


def _end(head: "subprocess.Popen[bytes]") -> None:
    for member in [head.pid, *descendants(head.pid)]:
        send_signal(member, signal.SIGKILL)
    head.wait()
