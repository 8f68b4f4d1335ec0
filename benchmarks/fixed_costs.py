"""What each stage costs before it does anything: seconds of its job on hardly any images.

    python benchmarks/fixed_costs.py [--out DIR] [--rounds 3] [--jobs make_shards train ...]

Runs the road's jobs one by one on a dozen simulated images, each as a process of its own, and
prints the least seconds of some rounds, from the call to its end, and as a ratio to a process that
imports torch and ends. What a job does with a dozen images takes well below a second. Jobs that use
Ray start it here, unless RAY_ADDRESS names one that runs.
"""

import argparse
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path

JOBS = Path(__file__).parents[1] / "jobs"
SMALL = "--train-locations 3 --test-locations 2 --distractors 1 --views 1 --size 64"
ROAD = {
    "simulate": f"--out {{out}}/flights {SMALL}",
    "make_shards": "--source university1652 --root {out}/flights --out {out}/shards",
    "train": "smoke --shards {out}/shards --out {out}/run --epochs 1 --batch-size 2",
    "embed_gallery": "--shards {out}/shards --out {out}/table --checkpoint {out}/run/last.pt",
    "embed_gallery, this process": "--shards {out}/shards --out {out}/here "
    "--checkpoint {out}/run/last.pt --workers 0",
    "build_index": "--table {out}/table --out {out}/index",
    "locate": "{out}/flights/test/query_drone --index {out}/index --out {out}/where.geojson "
    "--checkpoint {out}/run/last.pt",
    "evaluate": "--table {out}/table --out {out}/evaluation",
}
"Jobs in their order, and their arguments. Each makes what the next needs."
MADE = {
    "simulate": "flights", "make_shards": "shards", "train": "run", "embed_gallery": "table",
    "embed_gallery, this process": "here", "build_index": "index", "evaluate": "evaluation",
}  # fmt: skip
"What is removed before a job runs again, which else does nothing."


def seconds_of(command: Sequence[str]) -> float:
    """From the call of a process to its end. Raises RuntimeError where it fails."""
    begin = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)} ended with {done.returncode}:\n{done.stderr}")
    return time.perf_counter() - begin


def measure(name: str, out: Path, rounds: int) -> float:
    """The least seconds of a job."""
    words = ROAD[name].format(out=out).split()
    command = [sys.executable, str(JOBS / f"{name.partition(',')[0]}.py"), *words]
    seconds = []
    for _ in range(rounds):
        if name in MADE:
            shutil.rmtree(out / MADE[name], ignore_errors=True)
        seconds.append(seconds_of(command))
    return min(seconds)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, help="folder; a temporary one by default")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument(
        "--jobs",
        nargs="+",
        choices=ROAD,
        default=list(ROAD),
        help="each needs what those before make",
    )
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() if options.out is None else nullcontext(options.out) as out:
        importing = [sys.executable, "-c", "import torch"]
        baseline = min(seconds_of(importing) for _ in range(options.rounds))
        print("| job | seconds | x importing torch |\n|---|---|---|")
        print(f"| a process that imports torch | {baseline:.1f} | 1.0 x |")
        for name in options.jobs:
            seconds = measure(name, Path(out), options.rounds)
            print(f"| {name} | {seconds:.1f} | {seconds / baseline:.1f} x |", flush=True)


if __name__ == "__main__":
    main()
