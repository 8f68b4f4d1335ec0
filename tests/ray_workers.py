"""A cluster of Ray whose workers are forked from a process that has imported their libraries.

By itself each worker imports Ray and then torch, some three seconds of a core, and the tests start
hundreds. Here the process that a raylet starts for one ends in our hook (chaos/hook), which hands
its command to the process above the cluster; a fork of that goes on with Ray's own script.
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
"""What workers import. Not Ray: its C++ reads the job that a worker belongs to from the environment
when it is loaded."""


def serve(ray_start: list[str]) -> dict[str, Any]:
    """Start a cluster and fork a child per order; returns in the children only, with their order.

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
    while head.poll() is None:
        with suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
        if select.select([orders], [], [], 0.2)[0]:
            connection, _ = orders.accept()
            with connection, connection.makefile() as stream:
                order = json.load(stream)
            if not os.fork():
                orders.close()
                return dict(order)
    os._exit(head.returncode)


def run_worker(order: dict[str, Any]) -> None:
    """Do in this process what an order's command would do, and exit."""
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG: it ends with its cluster
    os.environ.clear()
    os.environ.update(order["environment"])
    os.chdir(order["folder"])
    sys.path[:] = order["path"]  # `ray job submit` brings a copy of the project
    run_script(order["command"])


if __name__ == "__main__":
    run_worker(serve(sys.argv[1:]))
