"""The check to run when a GPU is at hand: embedding and training, speed, parity and memory.

    python benchmarks/gpu.py --out DIR

Per network, ResNet-50 (`paper`) and the built-in encoder's (`builtin`): images per second from tar
to Parquet as a share of the bare encoder on batches in the device's memory, the same for a training
step (goals: at least .9), cosine of the embeddings with the CPU's float32, and peak memory. Each
measurement runs in a process of its own; DIR/gpu.json keeps it, and a rerun skips it. Stops after
--minutes with what it has. Prints one line per figure and a table for docs/results.md. On a machine
without a GPU it measures the CPU. Needs no Ray.
"""

import argparse
import json
import sys
import time
from multiprocessing import get_context
from pathlib import Path
from typing import Any

NETWORKS = ("ResNet-50", "built-in")
KINDS = ("embedding", "training")
GOAL = 0.9
"Share of the resident loop."
FILE = "gpu.json"
SETTINGS = (
    "width", "size", "batch", "train_batch", "steps", "rounds", "seconds", "compiling",
    "decoders", "compile_training",
)  # fmt: skip
"Flags that a measurement depends on: one with others is measured again."
Kept = dict[str, dict[str, Any]]
"Measurement -> its settings, hardware, date and figures."


def read_kept(out: Path) -> Kept:
    """The finished measurements."""
    path = out / FILE
    kept: Kept = json.loads(path.read_text()) if path.is_file() else {}
    return kept


def keep(out: Path, name: str, measurement: dict[str, Any]) -> None:
    """Add a measurement to the finished ones."""
    out.mkdir(parents=True, exist_ok=True)
    scratch = out / f"{FILE}.partial"
    scratch.write_text(json.dumps(read_kept(out) | {name: measurement}, indent=1))
    scratch.replace(out / FILE)


def measure(name: str, out: Path, settings: dict[str, Any]) -> None:
    """Measure in this process, and keep the figures."""
    from gpu_measurements import hardware, measure_embedding, measure_training

    kind, network = name.split(", ")
    function = measure_embedding if kind == "embedding" else measure_training
    found = function(network, **settings)
    date = time.strftime("%Y-%m-%d")
    measurement = {"settings": settings, "hardware": hardware(), "date": date, "figures": found}
    keep(out, name, measurement)


def measure_in_child(name: str, out: Path, settings: dict[str, Any], seconds: float) -> str | None:
    """Measure in a process of its own; why there are no figures, or None.

    A crash, for want of memory say, and a hang leave the other measurements alone.
    """
    # This process has not imported torch, so that its copy does so afresh.
    child = get_context("fork").Process(target=measure, args=(name, out, settings))
    child.start()
    child.join(seconds)
    if child.is_alive():
        child.kill()
        child.join()
        return "stopped by --minutes"
    return f"failed with exit code {child.exitcode}" if child.exitcode else None


def lines(name: str, figures: dict[str, Any]) -> list[str]:
    """One line per figure."""
    rate, resident = figures["images_per_second"], figures["resident_images_per_second"]
    found = [
        f"{name}: {rate:.1f} images/s, {rate / resident:.3f} x the resident loop's {resident:.1f} "
        f"(goal {GOAL}); {figures['how']}",
        f"{name}: peak memory {figures['peak_memory_mb']:.0f} MB ({figures['memory_of']})",
    ]
    if "cosine_worst" in figures:
        refused = "; a job would refuse it" * figures["refused"]
        found.append(
            f"{name}: cosine with the CPU's float32 {figures['cosine_worst']:.6f} at worst, "
            f"{figures['cosine_mean']:.6f} in the mean ({figures['weights']} weights{refused})"
        )
    return found


def table(kept: Kept) -> str:
    """The figures as Markdown, with hardware and date."""
    hardware = "; ".join(dict.fromkeys(one["hardware"] for one in kept.values()))
    dates = ", ".join(sorted({one["date"] for one in kept.values()}))
    rows = [
        f"## GPU check: `benchmarks/gpu.py`, {dates}",
        f"{hardware}.",
        "| | images/s | resident loop | share (goal .9) | cosine with the CPU, worst and mean "
        "| peak memory |\n|---|---|---|---|---|---|",
    ]
    for name, one in kept.items():
        figures = one["figures"]
        rate, resident = figures["images_per_second"], figures["resident_images_per_second"]
        cosine = (
            f"{figures['cosine_worst']:.6f}, {figures['cosine_mean']:.6f}"
            if "cosine_worst" in figures
            else ""
        )
        rows[-1] += (
            f"\n| {name}, {figures['how']} | {rate:.1f} | {resident:.1f} | {rate / resident:.3f} "
            f"| {cosine} | {figures['peak_memory_mb']:.0f} MB |"
        )
    return "\n\n".join(rows)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    add = parser.add_argument
    add("--out", type=Path, required=True, help=f"folder of {FILE}")
    add("--minutes", type=float, default=9.5, help="then it stops with what it has")
    add("--networks", nargs="+", choices=NETWORKS, default=NETWORKS, help="to measure")
    add("--width", type=float, default=1.0, help="channels of the networks, as a multiple")
    add("--size", type=int, default=256, help="side of their images, pixels")
    add("--batch", type=int, help="images embedded at a time; 256 on CUDA, else 8")
    add("--train-batch", type=int, help="images of a view per step; 64 on CUDA, else 4")
    add("--steps", type=int, help="steps of a round; 30 on CUDA, else 3")
    add("--rounds", type=int, default=3, help="alternating rounds")
    add("--seconds", type=float, default=4.0, help="length of a round of embedding, roughly")
    add("--compiling", default="always", help="of the encoder: auto, always, never")
    add("--decoders", type=int, help="threads that decode; by default all cores but one")
    add("--compile-training", action="store_true", help="compile the networks for training too")
    args = parser.parse_args()
    settings = {name: getattr(args, name) for name in SETTINGS}
    deadline, missing = time.monotonic() + 60 * args.minutes, list[str]()
    for name in (f"{kind}, {network}" for network in args.networks for kind in KINDS):
        problem = None
        if read_kept(args.out).get(name, {}).get("settings") == settings:
            print(f"{name}: kept from {args.out / FILE}")
        elif time.monotonic() >= deadline:
            problem = "stopped by --minutes"
        else:
            problem = measure_in_child(name, args.out, settings, deadline - time.monotonic())
        if problem:
            missing.append(name)
            print(f"{name}: not measured: {problem}", flush=True)
        else:
            print("\n".join(lines(name, read_kept(args.out)[name]["figures"])), flush=True)
    done = {name: one for name, one in read_kept(args.out).items() if name not in missing}
    if done:
        print(f"\n{table(done)}")
    if missing:
        print(f"\nnot measured: {'; '.join(missing)}. Run the same command again to resume.")
    return int(bool(missing))


if __name__ == "__main__":
    sys.exit(main())
