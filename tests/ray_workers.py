"""A cluster of Ray whose workers are forked from a process that has imported their libraries.

By itself each worker imports Ray and then torch, some three seconds of a core, and the tests start
more than a hundred. Here the process that a raylet starts for one ends in our hook (chaos/hook),
which hands its command to the process above the cluster. A fork of that goes on with Ray's own
script.
"""

import ctypes
import gc
import importlib
import json
import os
import select
import signal
import socket
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

from tests.launcher import run_script

SOCKET = "PVDA_TESTS_RAY_WORKERS"
"The environment variable that names the socket, for the hook."
LIBRARIES = (
    *("torch._dynamo", "safetensors.torch", "openvino", "webdataset", "tensorboard.summary"),
    *("pandas", "pyarrow.parquet", "scipy.io", "faiss", "cv2", "PIL.Image", "simplejpeg"),
    *("grpc", "aiohttp", "pydantic", "requests", "jsonschema", "tyro"),  # Ray imports most of them
)
"""What workers import. Not Ray: as it is loaded, its C++ reads from the environment which job the
worker is for. So each job has a process of its own that has imported Ray too."""
MOST_JOBS = 3
"With such a process at once: where there are more, the one unused for longest takes no orders."


def serve(ray_start: list[str]) -> dict[str, Any]:
    """Start a cluster and have a worker forked per order; returns in the workers only, with their
    order.

    The process exits when the cluster has ended.
    """
    Path(os.environ[SOCKET]).unlink(missing_ok=True)  # of a start that failed
    orders = socket.socket(socket.AF_UNIX)
    orders.bind(os.environ[SOCKET])
    orders.listen(64)
    head = subprocess.Popen(ray_start)
    os.environ["OMP_NUM_THREADS"] = "1"  # of torch, as Ray has it for an actor of one core
    for name in LIBRARIES:
        importlib.import_module(name)
    gc.freeze()
    jobs = dict[str, int]()
    while head.poll() is None:
        if not select.select([orders], [], [], 0.2)[0]:
            continue
        connection, _ = orders.accept()
        with connection, connection.makefile("rb") as stream:
            data = stream.read()
        environment = json.loads(data)["environment"]
        job = environment.get("RAY_JOB_ID", "")
        if job not in jobs:
            read, write = os.pipe()
            if not os.fork():
                orders.close()
                for pipe in (write, *jobs.values()):
                    os.close(pipe)
                return serve_job(read, environment)
            os.close(read)
            jobs[job] = write
        jobs[job] = jobs.pop(job)  # the last that was used
        os.write(jobs[job], data + b"\n")
        for former in list(jobs)[:-MOST_JOBS]:
            os.close(jobs.pop(former))
    os._exit(head.returncode)


def serve_job(pipe: int, environment: dict[str, str]) -> dict[str, Any]:
    """Import Ray for the job of that environment, and fork a worker per order on the pipe; returns
    in them only.

    The process exits when the pipe has been closed and the workers have ended.
    """
    end_with_parent()
    os.environ.update(environment)
    # Not ray.train: importing it draws one of Ray's random ids, after which all workers would draw
    # the same ones, and two that start at once would warm up the object store with one object.
    importlib.import_module("ray")
    gc.freeze()
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # the kernel forgets who has ended
    with os.fdopen(pipe) as orders:
        for line in orders:
            if not os.fork():
                signal.signal(signal.SIGCHLD, signal.SIG_DFL)
                return dict(json.loads(line))
    with suppress(ChildProcessError):
        os.wait()
    os._exit(0)


def run_worker(order: dict[str, Any]) -> None:
    """Do in this process what an order's command would do, and exit."""
    end_with_parent()
    os.environ.clear()
    os.environ.update(order["environment"])
    os.chdir(order["folder"])
    sys.path[:] = order["path"]  # `ray job submit` brings a copy of the project
    run_script(order["command"])


def end_with_parent() -> None:
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG


if __name__ == "__main__":
    run_worker(serve(sys.argv[1:]))
