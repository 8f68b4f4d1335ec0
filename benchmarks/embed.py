"""What a fast encoder gains over the plain one, as ratios of images per second within one run, with
its agreement.

The plain encoder is the field's: float32, NCHW, uncompiled, the mirror image in a second pass.
Rounds of all encoders take turns, so that whatever else the machine does meets all of them. Prints
one line per figure.
"""

import argparse
import time
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model.checkpoint import load_encoder
from model.config import PVDAConfig
from model.inference.embed import FastEncoder, embed
from model.inference.int8 import PrecisionError
from model.inference.optimise import MIN_COSINE, optimise_encoder
from model.inference.precision import Precision
from model.pvda import FeatureEncoder

CHOICES: dict[str, tuple[Precision, bool]] = {
    "folded": ("float32", False),
    "compiled": ("float32", True),
    "bfloat16": ("bfloat16", True),
    "int8": ("int8", True),
}
"Name -> precision, and whether it is compiled."


def soft_noise(count: int, size: int, seed: int) -> Tensor:
    """Bytes (count, 3, size, size), channels last as the embedder stacks them: noise at several
    scales.
    """
    generator = torch.Generator().manual_seed(seed)
    image = torch.zeros(count, 3, size, size)
    for cells, share in ((3, 0.5), (12, 0.3), (size, 0.2)):
        coarse = torch.rand(count, 3, cells, cells, generator=generator)
        image += F.interpolate(coarse, (size, size), mode="bicubic") * 255 * share
    return image.clamp(0, 255).to(torch.uint8).to(memory_format=torch.channels_last)


@torch.no_grad()
def made_encoder(config: PVDAConfig) -> FeatureEncoder:
    """Random weights, but features that are alive: each BatchNorm has random scales and the
    statistics of its input.

    The norm that ends a block's branch is small, as training leaves it. With scales around 1 there,
    fifty random layers multiply any rounding: at 128 px the cosine of bfloat16 fell from .9992 to
    .91, of int8 from .990 to .67.
    """
    torch.manual_seed(0)
    encoder = FeatureEncoder(config)
    last = "bn3" if config.depth >= 50 else "bn2"
    for name, module in encoder.named_modules():
        if isinstance(module, nn.modules.batchnorm._BatchNorm):
            module.momentum = None  # statistics are the mean over what was seen
            module.weight.uniform_(*((0.1, 0.3) if name.endswith(last) else (0.5, 1.5)))
            module.bias.normal_(0, 0.3)
    encoder(soft_noise(16, config.image_size, seed=1))
    return encoder.eval()


def seconds(encode: Callable[[Tensor], Tensor], images_B3HW: Tensor, device: str) -> float:
    """Of one pass. One thread on a CPU is timed by what it computed, which other work on the
    machine does not stretch.
    """
    clock = (
        time.process_time if device == "cpu" and torch.get_num_threads() == 1 else time.perf_counter
    )
    start = clock()
    encode(images_B3HW).cpu()  # waits for the device
    return clock() - start


def encoders(encoder: FeatureEncoder, arguments: argparse.Namespace) -> None:
    """The encoder alone, on a batch that is there: one line per way to compute it."""
    batch, mirror, device = arguments.batch_size, not arguments.no_mirror, arguments.device
    size = arguments.size
    images_B3HW = soft_noise(batch, size, seed=2)
    plain = encoder.to(device, memory_format=torch.contiguous_format)  # type: ignore[call-overload]
    ways: dict[str, Callable[[Tensor], Tensor]] = {
        "plain": lambda images: embed(plain, images.to(device), mirror)
    }
    made: dict[str, FastEncoder] = {}
    asked = dict(MIN_COSINE)
    MIN_COSINE.update(
        {"bfloat16": -1, "int8": -1}
    )  # what would be refused is timed too, and said to be so
    for name in arguments.ways:
        precision, compiled = CHOICES[name]
        start = time.perf_counter()
        try:
            made[name] = ways[name] = optimise_encoder(
                plain,
                precision=precision,
                mirror=mirror,
                compiled=compiled,
                batch_size=batch,
                probe_B3HW=soft_noise(arguments.probes, size, seed=3),
                calibration_B3HW=soft_noise(arguments.calibration, size, seed=4),
                say=lambda told: None,
            )
        except PrecisionError as error:
            print(f"{name}: not here: {error}")
        else:
            print(
                f"{name}: made in {time.perf_counter() - start:.0f} s, checks and calibration among them"
            )
    spent = {name: seconds(way, images_B3HW, device) for name, way in ways.items()}
    for _ in range(arguments.rounds):
        for name, way in ways.items():
            spent[name] = min(spent[name], seconds(way, images_B3HW, device))
    base = spent.pop("plain")
    print(f"plain: {batch / base:.2f} images/s")
    for name, best in spent.items():
        fast = made[name]
        refused = fast.mean_agreement if fast.precision == "int8" else fast.agreement
        print(
            f"{name}: {base / best:.2f} x the plain encoder's images per second ({batch / best:.2f} images/s; {fast.kind}; "
            f"cosine with the plain one {fast.mean_agreement:.6f} in the mean, {fast.agreement:.6f} at worst"
            f"{', which a job would refuse' if refused < asked[fast.precision] else ''})"
        )
    unlike_BE = embed(plain, soft_noise(arguments.probes, size, seed=3).to(device), mirror)
    others = (unlike_BE @ unlike_BE.T)[
        ~torch.eye(len(unlike_BE), dtype=torch.bool, device=unlike_BE.device)
    ]
    print(f"for comparison: cosine between different images {float(others.mean()):.4f} in the mean")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--checkpoint", help="a last.pt; by default ResNet-50 with random weights at 256 px"
    )
    parser.add_argument("--depth", type=int, default=50, help="of the random network")
    parser.add_argument(
        "--size", type=int, default=256, help="side of the random network's images in pixels"
    )
    parser.add_argument(
        "--ways", nargs="*", choices=CHOICES, default=["folded", "compiled", "int8"]
    )
    parser.add_argument("--batch-size", type=int, default=16)
    parser.add_argument("--rounds", type=int, default=3, help="the best of so many counts")
    parser.add_argument(
        "--probes", type=int, default=16, help="images that the agreement is measured on"
    )
    parser.add_argument(
        "--calibration", type=int, default=32, help="images that int8 is calibrated by"
    )
    parser.add_argument("--no-mirror", action="store_true")
    arguments = parser.parse_args()
    arguments.device = "cuda" if torch.cuda.is_available() else "cpu"
    if arguments.checkpoint:
        encoder = load_encoder(arguments.checkpoint)
    else:
        encoder = made_encoder(PVDAConfig(depth=arguments.depth, image_size=arguments.size))
    print(f"{arguments.device}, torch {torch.__version__}, {torch.get_num_threads()} threads")
    encoders(encoder, arguments)


if __name__ == "__main__":
    main()
