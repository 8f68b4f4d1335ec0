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
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from tests.launcher import ROOT
from tests.ray_workers import SOCKET

LOG, STARTED = "head.log", "Ray runtime started"
"Where `ray start` writes, and what, when its node takes drivers."


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


@dataclass(frozen=True, kw_only=True)
class Cluster:
    """A cluster of Ray on this machine."""

    pid: int
    "Of the process above all of its processes."
    address: str
    "Of drivers: RAY_ADDRESS."
    dashboard: str
    "URL for `ray job submit`: RAY_API_SERVER_ADDRESS."


@contextmanager
def start_cluster(cpus: int, environment: dict[str, str]) -> Iterator[Cluster]:
    """A Ray cluster on ports and in a session folder of its own.

    Tried three times: Ray gives its parts 30 s each, which a busy machine exceeds now and then.
    """
    # Not in pytest's folder: the paths of Ray's sockets may have 107 characters.
    with tempfile.TemporaryDirectory(prefix="ray-", ignore_cleanup_errors=True) as scratch:
        with one_start_of_ray():
            for attempt in (1, 2, 3):
                head, cluster = _start_head(cpus, environment, scratch)
                if _wait_until_started(head, Path(scratch, LOG)):
                    break
                _end(head)
                if attempt == 3:
                    raise RuntimeError("Ray has not started")
        try:
            yield cluster
        finally:
            _end(head)


def free_ports(count: int) -> list[int]:
    with ExitStack() as open_sockets:
        sockets = [open_sockets.enter_context(socket.socket()) for _ in range(count)]
        for one in sockets:
            one.bind(("127.0.0.1", 0))
        return [int(one.getsockname()[1]) for one in sockets]


def _start_head(
    cpus: int, environment: dict[str, str], scratch: str
) -> tuple["subprocess.Popen[bytes]", Cluster]:
    port, dashboard, client, agent, metrics, environments = free_ports(6)
    # With its dashboard: Ray Train asks it whether a controller is alive, and without it keeps the
    # resources of a dead one reserved.
    # Ports of agents that are given need not be waited for: the raylet waits 15 s, and dies.
    words = (
        f"start --head --block --disable-usage-stats --node-ip-address=127.0.0.1 --port={port} "
        f"--dashboard-port={dashboard} --dashboard-agent-listen-port={agent} "
        f"--dashboard-agent-grpc-port={metrics} --runtime-env-agent-port={environments} "
        f"--ray-client-server-port={client} --num-cpus={cpus} --temp-dir={scratch} --no-monitor "
        # It follows the workers' output for drivers, and ours want none: see cluster.connect.
        "--include-log-monitor=false"
    )
    folder = Path(sys.executable).parent
    # `python` of a submitted job is the first of its node's PATH.
    path = os.pathsep.join((str(folder), os.environ["PATH"]))
    workers = {SOCKET: str(Path(scratch, "workers"))}
    environment = os.environ | {"PATH": path} | environment | workers
    environment.pop("RAY_ADDRESS", None)  # of another cluster
    with Path(scratch, LOG).open("wb") as log:
        head = subprocess.Popen(
            [sys.executable, "-m", "tests.ray_workers", str(folder / "ray"), *words.split()],
            cwd=ROOT,
            env=environment,
            start_new_session=True,
            stdout=log,
            stderr=log,
        )
    return head, Cluster(
        pid=head.pid,
        address=f"127.0.0.1:{port}",
        dashboard=f"http://127.0.0.1:{dashboard}",
    )


def _wait_until_started(head: "subprocess.Popen[bytes]", log: Path) -> bool:
    """Whether it starts within two minutes: its node is known then, and takes drivers."""
    deadline = time.monotonic() + 120
    while head.poll() is None and time.monotonic() < deadline:
        if STARTED in log.read_text(errors="replace"):
            return True
        time.sleep(0.1)
    return False


def _end(head: "subprocess.Popen[bytes]") -> None:
    for member in [head.pid, *descendants(head.pid)]:
        send_signal(member, signal.SIGKILL)
    head.wait()
