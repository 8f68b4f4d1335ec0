"""The service under load from another process: latency and rate, and the gain of batching.

Starts jobs/serve.py twice, with batches of one photo and with larger ones, and sends requests to
both alternately, by 1, 8 and 32 clients; each client sends its next photo when the last one is
answered. Prints one line per figure; the gain is a ratio to batches of one in the same run.
Loopback only; bounded in time and number of requests.

    python benchmarks/serve.py --checkpoint run/last.pt --index index \
        --photos flights/test/query_drone
"""

import argparse
import asyncio
import itertools
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import aiohttp
import numpy as np

ROOT = Path(__file__).parent.parent
CLIENTS = (1, 8, 32)
MAX_REQUESTS = 5_000
"Requests of one measurement, at most."
MAX_PHOTOS = 200
TIMEOUT_S = 180
"Longest start of a service."

LISTENS = re.compile(r"(http://127\.0\.0\.1:\d+) listens")
Measurement = tuple[list[float], float, Counter[int]]
"Latencies in seconds, duration, and number of requests by status."


@contextmanager
def service(args: argparse.Namespace, *flags: str) -> Iterator[str]:
    """Start a service on a free port; yields its address as soon as it listens."""
    command = [sys.executable, str(ROOT / "jobs" / "serve.py"), "--port", "0", *flags]
    command += ["--checkpoint", args.checkpoint, "--index", args.index]
    command += ["--threads", str(args.threads)] if args.threads else []
    environment = {"RAY_ADDRESS": "local"} | os.environ
    with (
        tempfile.NamedTemporaryFile() as log,
        subprocess.Popen(command, env=environment, stderr=log, start_new_session=True) as process,
    ):
        try:
            address = None
            while address is None and process.poll() is None:
                time.sleep(0.05)
                address = LISTENS.search(Path(log.name).read_text())
            if address is None:
                raise RuntimeError("the service has ended")
            yield address[1]
        except Exception:
            print(Path(log.name).read_text()[-2000:], file=sys.stderr)
            raise
        finally:
            process.send_signal(signal.SIGTERM)
            process.wait(30)


async def wait_until_ready(session: aiohttp.ClientSession, address: str) -> None:
    deadline = time.monotonic() + TIMEOUT_S
    while time.monotonic() < deadline:
        async with session.get(f"{address}/health") as response:
            if response.status == 200:
                return
        await asyncio.sleep(0.5)
    raise SystemExit(f"{address} was not ready after {TIMEOUT_S} s")


async def load(
    session: aiohttp.ClientSession, address: str, photos: list[bytes], clients: int, seconds: float
) -> Measurement:
    """Send photos from so many clients for so many seconds."""
    latencies, statuses, numbers = list[float](), Counter[int](), itertools.count()
    begin = time.perf_counter()

    async def client() -> None:
        while time.perf_counter() < begin + seconds and (number := next(numbers)) < MAX_REQUESTS:
            sent = time.perf_counter()
            async with session.post(
                f"{address}/locate",
                data=photos[number % len(photos)],
                headers={"Content-Type": "image/jpeg"},
            ) as response:
                await response.read()
            statuses[response.status] += 1
            if response.status == 200:
                latencies.append(time.perf_counter() - sent)

    await asyncio.gather(*(client() for _ in range(clients)))
    return latencies, time.perf_counter() - begin, statuses


def print_latency(clients: int, name: str, rounds: list[Measurement]) -> float:
    """Print one setting's latency over all rounds; photos per second of its best round."""
    latencies = np.concatenate([np.asarray(one[0]) for one in rounds]) * 1000
    rates = [len(one[0]) / one[1] for one in rounds]
    statuses = sum((one[2] for one in rounds), Counter[int]())
    p50, p90, p99 = np.percentile(latencies, [50, 90, 99])
    listed = ", ".join(f"{rate:.1f}" for rate in rates)
    print(
        f"{clients:2d} clients, {name}: p50 {p50:.0f} ms, p90 {p90:.0f}, p99 {p99:.0f}, longest "
        f"{latencies.max():.0f}; {max(rates):.1f} photos/s (rounds {listed}); statuses "
        f"{dict(sorted(statuses.items()))}",
        flush=True,
    )
    return max(rates)


async def measure(args: argparse.Namespace, addresses: dict[str, str]) -> None:
    """Load the services alternately and print their latencies and the gain of batching."""
    photos = [path.read_bytes() for path in sorted(Path(args.photos).rglob("*.jp*g"))]
    random.Random(0).shuffle(photos)
    photos = photos[:MAX_PHOTOS]
    if not photos:
        raise SystemExit(f"no JPEG below {args.photos}")
    mean = sum(map(len, photos)) / len(photos) / 1000
    async with aiohttp.ClientSession(connector=aiohttp.TCPConnector(limit=0)) as session:
        for address in addresses.values():
            await wait_until_ready(session, address)
            # The first batch of each size is slow.
            await load(session, address, photos, args.batch, args.seconds)
        print(
            f"{len(photos)} photos, {mean:.0f} kB in the mean; {args.rounds} alternating rounds of "
            f"{args.seconds:g} s"
        )
        for clients in args.clients:
            rounds: dict[str, list[Measurement]] = {name: [] for name in addresses}
            for _ in range(args.rounds):
                for name, address in addresses.items():
                    rounds[name].append(await load(session, address, photos, clients, args.seconds))
            single, batched = (print_latency(clients, name, all_) for name, all_ in rounds.items())
            print(
                f"{clients:2d} clients: batching {batched / single:.2f} x the photos/s of one at "
                "a time",
                flush=True,
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    add = parser.add_argument
    add("--checkpoint", required=True)
    add("--index", required=True)
    add("--photos", required=True, help="folder of JPEGs")
    add("--clients", type=int, nargs="+", default=CLIENTS, help="concurrent clients, in turn")
    add("--seconds", type=float, default=6, help="length of a measurement")
    add("--rounds", type=int, default=2, help="alternating rounds")
    add("--batch", type=int, default=8, help="photos of the larger batch")
    add("--threads", type=int, help="cores of each service; in a Ray of both (RAY_ADDRESS), half")
    args = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # ends the services too
    with (
        service(args, "--batch", "1") as single,
        service(args, "--batch", str(args.batch)) as batched,
    ):
        addresses = {"one at a time": single, f"batches of up to {args.batch}": batched}
        asyncio.run(measure(args, addresses))


if __name__ == "__main__":
    main()
