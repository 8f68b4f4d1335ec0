"""The processes of a job and of a Ray cluster on this machine: which there are, and how a cluster
of our own is begun.

Linux's /proc is read; psutil would be one more dependency for three lines.
"""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


def named(pid: int) -> str:
    """A process's command line; empty when it is gone."""
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


def below(pid: int) -> list[int]:
    """All descendants of a process."""
    children: dict[int, list[int]] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with suppress(OSError, IndexError):  # gone meanwhile
                parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
                children.setdefault(parent, []).append(int(entry.name))
    found, todo = list[int](), [pid]
    while todo:
        more = children.get(todo.pop(), [])
        found += more
        todo += more
    return sorted(found)


def working(pid: int) -> list[int]:
    """Ray's workers below a process that have something to do; its agents, whose death takes the
    node along, are none.
    """
    passed_over = ("ray::IDLE", "ray::DashboardAgent", "ray::RuntimeEnvAgent")
    return [
        one
        for one in below(pid)
        if (name := named(one)).startswith("ray::") and not name.startswith(passed_over)
    ]


def daemons(pid: int) -> list[int]:
    """Ray's own processes below a process: without the raylet or the GCS there is no cluster."""
    return [
        one
        for one in below(pid)
        if any(word in named(one) for word in ("raylet/raylet", "gcs/gcs_server"))
    ]


def strike(pid: int, kind: signal.Signals) -> bool:
    """Send a signal; whether there was anyone to have it."""
    try:
        os.kill(pid, kind)
    except ProcessLookupError:
        return False
    return True


@contextmanager
def cluster(cpus: int, environment: dict[str, str]) -> Iterator[tuple[int, str]]:
    """A Ray cluster of this machine: the process above all of it, and its address."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    # With its dashboard: Ray Train asks it whether a controller lives, and keeps a dead one's
    # places where there is none.
    words = ["start", "--head", "--block", f"--port={port}", f"--num-cpus={cpus}"]
    ray = Path(sys.executable).with_name("ray")
    head = subprocess.Popen(
        [str(ray), *words, "--disable-usage-stats", "--node-ip-address=127.0.0.1"],
        env=os.environ | environment,
        start_new_session=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        deadline = time.monotonic() + 60
        while not any("raylet/raylet" in named(one) for one in below(head.pid)):
            if head.poll() is not None or time.monotonic() > deadline:
                raise RuntimeError("Ray has not started")
            time.sleep(0.1)
        yield head.pid, f"127.0.0.1:{port}"
    finally:
        everyone = [head.pid, *below(head.pid)]
        for one in everyone:
            strike(one, signal.SIGKILL)
        head.wait()
