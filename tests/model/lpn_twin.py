"""LPN's network again, from its public description alone, to compare an import with."""

import math
from collections.abc import Callable
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from jobs.stages.import_weights import import_weights
from jobs.stages.settings import ImportWeightsSettings
from model.checkpoint import Checkpoint, loads

State = dict[str, Tensor]
MEAN, DEVIATION = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])


# A twin of the original network, written from its description and from nothing of ours.


def made_up(
    blocks: tuple[int, ...] = (2, 2, 2, 2), grown: int = 1, base: int = 16, seed: int = 0
) -> State:
    """Random weights of a ResNet under torchvision's names; `grown` is 4 with bottlenecks, 1
    without.
    """
    generator, state = torch.Generator().manual_seed(seed), State()

    def conv(name: str, out: int, into: int, side: int) -> None:
        deviation = math.sqrt(2 / (into * side * side))
        state[f"{name}.weight"] = (
            torch.randn(out, into, side, side, generator=generator) * deviation
        )

    conv("conv1", base, 3, 7)
    state |= norm("bn1", base, generator)
    into = base
    for layer, count in enumerate(blocks, start=1):
        width = base * 2 ** (layer - 1)
        for block in range(count):
            at, out = f"layer{layer}.{block}", width * grown
            shapes = (
                [(width, into, 3), (out, width, 3)]
                if grown == 1
                else [(width, into, 1), (width, width, 3), (out, width, 1)]
            )
            for number, (to, of, side) in enumerate(shapes, start=1):
                conv(f"{at}.conv{number}", to, of, side)
                state |= norm(f"{at}.bn{number}", to, generator)
            if block == 0 and (layer > 1 or grown > 1):
                conv(f"{at}.downsample.0", out, into, 1)
                state |= norm(f"{at}.downsample.1", out, generator)
            into = out
    return state


def norm(name: str, size: int, generator: torch.Generator) -> State:
    def noise() -> Tensor:
        return 0.1 * torch.randn(size, generator=generator)

    values = {
        "weight": 1 + noise(),
        "bias": noise(),
        "running_mean": noise(),
        "running_var": 1 + noise().abs(),
    }
    return {f"{name}.{key}": value for key, value in values.items()} | {
        f"{name}.num_batches_tracked": torch.tensor(87)
    }


def three_view_net(
    backbone: State, parts: int = 4, part_dim: int = 24, locations: int = 5
) -> State:
    """As LPN saves a network whose UAV and satellite images share a backbone: it appears under both
    names.
    """
    generator = torch.Generator().manual_seed(7)
    fc = {"fc.weight": torch.ones(1000, 8), "fc.bias": torch.ones(1000)}
    state = {
        f"{view}.model.{key}": value
        for view in ("model_1", "model_3")
        for key, value in (backbone | fc).items()
    }
    state |= {
        f"model_2.model.{key}": value + 1 for key, value in (backbone | fc).items()
    }  # street images
    channels = max(
        value.shape[0] for key, value in backbone.items() if key.startswith("layer4") and value.ndim
    )
    for part in range(parts):
        at = f"classifier{part}"
        state[f"{at}.add_block.0.weight"] = torch.randn(
            part_dim, channels, generator=generator
        ) / math.sqrt(channels)
        state[f"{at}.add_block.0.bias"] = torch.randn(part_dim, generator=generator)
        state |= norm(f"{at}.add_block.1", part_dim, generator)
        state[f"{at}.classifier.0.weight"] = torch.randn(locations, part_dim, generator=generator)
        state[f"{at}.classifier.0.bias"] = torch.randn(locations, generator=generator)
    return state


def normalised(state: State, at: str, x: Tensor) -> Tensor:
    mean, variance, weight, bias = (
        state[f"{at}.{key}"] for key in ("running_mean", "running_var", "weight", "bias")
    )
    return F.batch_norm(x, mean, variance, weight, bias, eps=1e-5)


def twin_maps(state: State, x: Tensor) -> Tensor:
    """ResNet with stride 1 in layer4."""
    x = F.relu(normalised(state, "bn1", F.conv2d(x, state["conv1.weight"], stride=2, padding=3)))
    x = F.max_pool2d(x, 3, 2, 1)
    for layer, stride in ((1, 1), (2, 2), (3, 2), (4, 1)):
        block = 0
        while f"layer{layer}.{block}.conv1.weight" in state:
            at, step, y = f"layer{layer}.{block}", stride if block == 0 else 1, x
            convs = [n for n in (1, 2, 3) if f"{at}.conv{n}.weight" in state]
            for n in convs:
                weight = state[f"{at}.conv{n}.weight"]
                here = (
                    step if n == len(convs) - 1 else 1
                )  # on the first of two, the second of three
                y = normalised(
                    state,
                    f"{at}.bn{n}",
                    F.conv2d(y, weight, stride=here, padding=weight.shape[-1] // 2),
                )
                y = F.relu(y) if n < len(convs) else y
            if f"{at}.downsample.0.weight" in state:
                x = normalised(
                    state,
                    f"{at}.downsample.1",
                    F.conv2d(x, state[f"{at}.downsample.0.weight"], stride=step),
                )
            x, block = F.relu(x + y), block + 1
    return x


def twin_parts(state: State, images: Tensor, parts: int) -> Tensor:
    """What LPN calls a feature: (B, D, P), centre first, each ring its box with the hole filled
    with zeros.
    """
    images = (images.float() / 255 - MEAN[:, None, None]) / DEVIATION[:, None, None]
    backbone = {
        key.removeprefix("model_1.model."): value
        for key, value in state.items()
        if key.startswith("model_1")
    }
    maps = twin_maps(backbone, images)
    centre, step = maps.shape[2] // 2, maps.shape[2] // (2 * parts)
    features = []
    for part in range(1, parts + 1):
        half = part * step if part < parts else centre
        box = maps[:, :, centre - half : centre + half, centre - half : centre + half].clone()
        hole = (part - 1) * step
        box[:, :, half - hole : half + hole, half - hole : half + hole] = 0
        mean = torch.nn.AdaptiveAvgPool2d(1)(box).flatten(1)
        at = f"classifier{part - 1}.add_block"
        features.append(
            normalised(
                state, f"{at}.1", F.linear(mean, state[f"{at}.0.weight"], state[f"{at}.0.bias"])
            )
        )
    return torch.stack(features, 2)


def twin_embedding(state: State, images: Tensor, parts: int) -> Tensor:
    summed = twin_parts(state, images, parts) + twin_parts(state, images.flip(3), parts)
    unit: Tensor = summed / (summed.norm(dim=1, keepdim=True) * math.sqrt(parts))
    # LPN lays the numbers of all parts side by side; ours stand part after part. Inner products are
    # the same.
    return unit.transpose(1, 2).flatten(1)


def photos(size: int, count: int = 2) -> Tensor:
    """Fields of random colours, 8 by 8: images of noise would all look alike."""
    fields = torch.randint(
        0, 256, (count, 3, 8, 8), dtype=torch.uint8, generator=torch.Generator().manual_seed(1)
    )
    return fields.repeat_interleave(size // 8, 2).repeat_interleave(size // 8, 3)


def saved(state: State, path: Path) -> str:
    torch.save(state, path)
    return str(path)


def imported(tmp_path: Path, state: State, image_size: int = 128) -> Checkpoint:
    given = saved(state, tmp_path / "net_119.pth")
    out = import_weights(
        ImportWeightsSettings(lpn=given, out=str(tmp_path / "ours.pt"), image_size=image_size)
    )
    return loads(Path(out).read_bytes())


def without(state: State, start: str) -> State:
    return {key: value for key, value in state.items() if not key.startswith(start)}


def changed(key: str, value: Callable[[Tensor], Tensor]) -> Callable[[State], State]:
    return lambda state: state | {key: value(state[key])}
