"""The service under load from another process: latency and rate at 1, 8 and 32 clients, and what
batching gains.

Starts jobs/serve.py twice, with batches of one photo and as it comes, and asks them by turns; each
client sends its next photo when the last one is answered. Prints one line per figure. Loopback
only; bounded in time and number of requests.

    python benchmarks/serve.py --checkpoint run/last.pt --index index --photos
    flights/test/query_drone
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
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import aiohttp
import numpy as np

ROOT = Path(__file__).parent.parent
CLIENTS = (1, 8, 32)
MOST_REQUESTS = 5_000
"Of one measurement."
MOST_PHOTOS = 200
PATIENCE_S = 180
"For a service to be ready."


@contextmanager
def service(given: argparse.Namespace, *flags: str) -> Iterator[str]:
    """A service of its own on a free port: its address, as soon as it listens."""
    command = [
        sys.executable,
        str(ROOT / "jobs" / "serve.py"),
        "--checkpoint",
        given.checkpoint,
        "--index",
        given.index,
    ]
    command += ["--port", "0", *flags]
    environment = os.environ | {"RAY_ADDRESS": "local"}
    with subprocess.Popen(
        command, env=environment, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        try:
            assert process.stderr is not None
            heard = process.stderr.readline()
            address = re.match(r"(http://127\.0\.0\.1:\d+) listens", heard)
            if address is None:
                raise SystemExit(heard + process.stderr.read())
            yield address[1]
        finally:
            process.send_signal(signal.SIGTERM)
            process.wait(30)


async def ready(session: aiohttp.ClientSession, address: str) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        async with session.get(f"{address}/health") as response:
            if response.status == 200:
                return
        await asyncio.sleep(0.5)
    raise SystemExit(f"{address} was not ready after {PATIENCE_S} s")


async def load(
    session: aiohttp.ClientSession, address: str, photos: list[bytes], clients: int, seconds: float
) -> tuple[list[float], float, Counter[int]]:
    """Seconds of each answered request, seconds in all, and how many had which status."""
    latencies, statuses, numbers = list[float](), Counter[int](), itertools.count()
    began = time.perf_counter()

    async def client() -> None:
        while time.perf_counter() < began + seconds and (number := next(numbers)) < MOST_REQUESTS:
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
    return latencies, time.perf_counter() - began, statuses


def told(clients: int, name: str, found: list[tuple[list[float], float, Counter[int]]]) -> float:
    """Print what all rounds of a setting found; its requests per second in the best round."""
    latencies = np.concatenate([np.asarray(round_[0]) for round_ in found]) * 1000
    rates = [len(round_[0]) / round_[1] for round_ in found]
    statuses = sum((round_[2] for round_ in found), Counter[int]())
    p50, p90, p99 = np.percentile(latencies, [50, 90, 99])
    print(
        f"{clients:2d} clients, {name}: p50 {p50:.0f} ms, p90 {p90:.0f}, p99 {p99:.0f}, longest {latencies.max():.0f}; "
        f"{max(rates):.1f} photos/s (rounds {', '.join(f'{rate:.1f}' for rate in rates)}); "
        f"statuses {dict(sorted(statuses.items()))}",
        flush=True,
    )
    return max(rates)


async def measure(given: argparse.Namespace, addresses: dict[str, str]) -> None:
    photos = [path.read_bytes() for path in sorted(Path(given.photos).rglob("*.jp*g"))]
    random.Random(0).shuffle(photos)
    photos = photos[:MOST_PHOTOS]
    if not photos:
        raise SystemExit(f"no JPEG below {given.photos}")
    mean = sum(map(len, photos)) / len(photos) / 1000
    async with aiohttp.ClientSession(connector=aiohttp.TCPConnector(limit=0)) as session:
        for address in addresses.values():
            await ready(session, address)
            await load(
                session, address, photos, given.batch, given.seconds
            )  # each size of batch is slow the first time
        print(
            f"{len(photos)} photos, {mean:.0f} kB in the mean; {given.rounds} rounds of {given.seconds:g} s by turns"
        )
        for clients in given.clients:
            found: dict[str, list[tuple[list[float], float, Counter[int]]]] = {
                name: [] for name in addresses
            }
            for _ in range(given.rounds):
                for name, address in addresses.items():
                    found[name].append(await load(session, address, photos, clients, given.seconds))
            alone, batched = (told(clients, name, rounds) for name, rounds in found.items())
            print(
                f"{clients:2d} clients: batching {batched / alone:.2f} x the photos/s of one at a time",
                flush=True,
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--checkpoint", required=True)
    parser.add_argument("--index", required=True)
    parser.add_argument("--photos", required=True, help="folder of JPEGs")
    parser.add_argument(
        "--clients", type=int, nargs="+", default=CLIENTS, help="that ask at the same time"
    )
    parser.add_argument("--seconds", type=float, default=6, help="of a measurement")
    parser.add_argument("--rounds", type=int, default=2, help="of all in turn")
    parser.add_argument("--batch", type=int, default=8, help="photos of the larger batch")
    given = parser.parse_args()
    signal.signal(
        signal.SIGTERM, lambda *_: sys.exit(143)
    )  # told to stop, it ends the services too
    with (
        service(given, "--batch", "1") as alone,
        service(given, "--batch", str(given.batch)) as batched,
    ):
        asyncio.run(
            measure(given, {"one at a time": alone, f"batches of up to {given.batch}": batched})
        )


if __name__ == "__main__":
    main()
