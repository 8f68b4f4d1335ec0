"""Optimised encoders against the plain one: images per second as a ratio, and agreement.

The plain encoder is the field's: float32, NCHW, uncompiled, the mirror image in a second pass. All
encoders alternate, so that other work on the machine slows all of them. Prints one line per figure.
"""

import argparse
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from unittest.mock import patch

import torch
from embedding_worker import recipe_of, soft_noise
from torch import Tensor, nn

from jobs.encoding.encoder import read_checkpoint_bytes, trained_on_mirrors
from model.backbones import BACKBONES
from model.checkpoint import build_encoder, loads
from model.config import PVDAConfig
from model.inference import optimise
from model.inference.compile import NotCompiled
from model.inference.embed import FastEncoder, embed
from model.inference.int8 import PrecisionError
from model.inference.optimise import MIN_COSINE, optimise_encoder
from model.inference.precision import Precision
from model.pvda import FeatureEncoder

CHOICES: dict[str, tuple[Precision, bool]] = {
    "folded": ("float32", False),
    "openvino": ("float32", True),
    "compiled": ("float32", True),
    "bfloat16": ("bfloat16", True),
    "int8": ("int8", True),
}
"Name -> precision, and whether it is compiled; `compiled` by torch, also where OpenVINO could."


@torch.no_grad()
def random_encoder(config: PVDAConfig) -> FeatureEncoder:
    """Random weights with usable features: BatchNorms of random scale, fitted to their input.

    The norm that ends a block's branch is small, as training leaves it. With scales around 1 there,
    fifty random layers multiply any rounding: at 128 px the cosine of bfloat16 fell from .9992 to
    .91, of int8 from .990 to .67.
    """
    torch.manual_seed(0)
    encoder = FeatureEncoder(config)
    last = "bn2" if config.backbone in ("resnet18", "resnet34") else ("bn3", "project.norm")
    for name, module in encoder.named_modules():
        if isinstance(module, nn.modules.batchnorm._BatchNorm):
            module.momentum = None  # the statistics become the mean over all input
            module.weight.uniform_(*((0.1, 0.3) if name.endswith(last) else (0.5, 1.5)))
            module.bias.normal_(0, 0.3)
    encoder(soft_noise(16, config.image_size, seed=1))
    return encoder.eval()


def by_torch() -> AbstractContextManager[object]:
    """Within it, OpenVINO compiles nothing."""
    left_out = NotCompiled("left out, to compare")
    return patch.object(optimise, "compile_openvino", side_effect=left_out)


def pass_seconds(encode: Callable[[Tensor], Tensor], images_B3HW: Tensor, device: str) -> float:
    """Duration of one pass; of one thread on a CPU its CPU time, which other work leaves alone."""
    one_thread = device == "cpu" and torch.get_num_threads() == 1
    clock = time.process_time if one_thread else time.perf_counter
    begin = clock()
    encode(images_B3HW).cpu()  # waits for the device
    return clock() - begin


def compare_encoders(
    encoder: FeatureEncoder, size: int, mirror: bool, args: argparse.Namespace
) -> None:
    """Print one line per optimised encoder, on a batch in memory."""
    batch, device = args.batch_size, args.device
    images_B3HW = soft_noise(batch, size, seed=2)
    probe_B3HW = soft_noise(args.probes, size, seed=3)
    plain = encoder.to(device, memory_format=torch.contiguous_format)  # type: ignore[call-overload]
    encoders: dict[str, Callable[[Tensor], Tensor]] = {
        "plain": lambda images: embed(plain, images.to(device), mirror)
    }
    optimised: dict[str, FastEncoder] = {}
    required = dict(MIN_COSINE)
    # Time encoders below the required agreement as well; their lines say so.
    MIN_COSINE.update({"bfloat16": -1, "int8": -1})
    for name in args.encoders:
        precision, compiled = CHOICES[name]
        begin = time.perf_counter()
        try:
            with by_torch() if name == "compiled" else nullcontext():
                optimised[name] = encoders[name] = optimise_encoder(
                    plain,
                    precision=precision,
                    mirror=mirror,
                    compiled=compiled,
                    batch_size=batch,
                    probe_B3HW=probe_B3HW,
                    calibration_B3HW=soft_noise(args.calibration, size, seed=4),
                    log=lambda message: None,
                )
        except PrecisionError as error:
            print(f"{name}: not available here: {error}")
        else:
            seconds = time.perf_counter() - begin
            print(f"{name}: built in {seconds:.0f} s, checks and calibration included")
    best = {name: pass_seconds(one, images_B3HW, device) for name, one in encoders.items()}
    for _ in range(args.rounds):
        for name, one in encoders.items():
            best[name] = min(best[name], pass_seconds(one, images_B3HW, device))
    baseline = best.pop("plain")
    print(f"plain: {batch / baseline:.2f} images/s")
    for name, seconds in best.items():
        fast = optimised[name]
        is_refused = fast.judged_agreement < required[fast.precision]
        refused = ", which a job would refuse" * is_refused
        print(
            f"{name}: {baseline / seconds:.2f} x the plain encoder's images per second "
            f"({batch / seconds:.2f} images/s; {fast.kind}; cosine with the plain one "
            f"{fast.mean_agreement:.6f} in the mean, {fast.agreement:.6f} at worst{refused})"
        )
    distinct_BE = embed(plain, probe_B3HW.to(device), mirror)
    is_other_BB = ~torch.eye(len(distinct_BE), dtype=torch.bool, device=distinct_BE.device)
    cosine = float((distinct_BE @ distinct_BE.T)[is_other_BB].mean())
    print(f"for comparison: cosine between different images {cosine:.4f} in the mean")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    add = parser.add_argument
    add("--checkpoint", help="builtin, or a last.pt; by default random weights")
    add("--backbone", default="resnet50", choices=BACKBONES, help="with its recipe's rings")
    add("--width", type=float, default=1.0, help="its channels, as a multiple")
    add("--size", type=int, help="side of its images, pixels; by default its recipe's, or 256")
    add("--encoders", nargs="*", choices=CHOICES, default=["folded", "openvino", "compiled"])
    add("--batch-size", type=int, default=16)
    add("--rounds", type=int, default=3, help="alternating rounds, of which the best counts")
    add("--probes", type=int, default=16, help="images that the agreement is measured on")
    add("--calibration", type=int, default=32, help="images that int8 is calibrated by")
    add("--no-mirror", action="store_true", help="where training mirrored images as well")
    args = parser.parse_args()
    args.device = "cuda" if torch.cuda.is_available() else "cpu"
    if args.checkpoint:
        checkpoint = loads(read_checkpoint_bytes(args.checkpoint), args.checkpoint)
        encoder = build_encoder(checkpoint)
        config = replace(checkpoint.network, image_size=args.size or checkpoint.network.image_size)
        mirror = trained_on_mirrors(checkpoint)
    else:
        recipe = recipe_of(args.backbone, args.width, args.size or 256)
        config, encoder = recipe.network, random_encoder(recipe.network)
        mirror = recipe.augmentation.mirror
    print(f"{args.device}, torch {torch.__version__}, {torch.get_num_threads()} threads")
    compare_encoders(encoder, config.image_size, mirror and not args.no_mirror, args)


if __name__ == "__main__":
    main()
