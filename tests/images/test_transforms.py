"""Resizing against Pillow.

Shapes: H x W pixels.
"""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from pipeline.core.arrays import Pixels
from pipeline.images.transforms import Resizer, preprocessing_name, resize

ROOT = Path(__file__).parents[2]
RESIZERS: tuple[Resizer, ...] = ("torch", "pillow")


def noise(height: int = 37, width: int = 50) -> Pixels:
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)


@pytest.mark.parametrize(("height", "width"), [(37, 50), (16, 16), (3, 2), (100, 64)])
def test_resize_by_pillow_is_its_antialiased_bicubic(height: int, width: int) -> None:
    image_HW3 = noise(height, width)
    expected = Image.fromarray(image_HW3).resize((16, 16), Image.Resampling.BICUBIC)
    assert np.array_equal(resize(image_HW3, 16, "pillow"), np.asarray(expected))


@settings(max_examples=100)
@given(
    height=st.integers(1, 200),
    width=st.integers(1, 200),
    size=st.integers(1, 200),
    seed=st.integers(0, 99),
    extremes=st.booleans(),
)
def test_resize_by_torch_is_within_two_levels_of_pillow(
    height: int, width: int, size: int, seed: int, extremes: bool
) -> None:
    image_HW3 = np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)
    if extremes:  # black and white alone: where a filter overshoots
        image_HW3 = np.where(image_HW3 < 128, 0, 255).astype(np.uint8)
    image_HW3.flags.writeable = False  # as Pillow's are: torch would warn
    found_HW3 = resize(image_HW3, size)
    assert found_HW3.shape == (size, size, 3)
    # Along the rows first, whatever Pillow's version thinks best: between the passes values are
    # clipped.
    rows = Image.fromarray(image_HW3).resize((size, height), Image.Resampling.BICUBIC)
    expected_HW3 = np.asarray(rows.resize((size, size), Image.Resampling.BICUBIC))
    apart_HW3 = np.abs(found_HW3.astype(np.int64) - expected_HW3)
    assert apart_HW3.max() <= 2
    assert (apart_HW3 == 2).sum() <= 2 + 0.001 * apart_HW3.size


@pytest.mark.parametrize(
    ("height", "width", "size"), [(512, 512, 256), (750, 1000, 256), (1000, 750, 256), (96, 96, 64)]
)
def test_resize_of_photos_is_within_one_level_of_pillow(height: int, width: int, size: int) -> None:
    image_HW3 = noise(height, width)
    by_torch, by_pillow = (resize(image_HW3, size, by).astype(np.int64) for by in RESIZERS)
    assert np.abs(by_torch - by_pillow).max() <= 1


def test_resize_by_torch_gives_memory_of_its_own() -> None:
    image_HW3 = noise()
    found_HW3 = resize(image_HW3, 16)
    assert found_HW3.flags.c_contiguous
    assert found_HW3.dtype == np.uint8
    assert not np.shares_memory(found_HW3, image_HW3)
    assert np.array_equal(
        resize(image_HW3[:, ::-1], 16), resize(np.ascontiguousarray(image_HW3[:, ::-1]), 16)
    )


@pytest.mark.skipif(
    torch.backends.cpu.get_cpu_capability() not in ("AVX2", "AVX512"),
    reason="torch's code for other CPUs is parallel",
)
@pytest.mark.skipif(
    not Path("/proc/self/task").exists(), reason="threads are counted as Linux shows them"
)
@pytest.mark.slow
def test_resize_in_threads_starts_no_threads_of_its_own() -> None:
    script = (
        "import os, numpy, torch\n"
        "from concurrent.futures import ThreadPoolExecutor\n"
        "from pipeline.images.transforms import resize\n"
        "torch.set_num_threads(8)\n"
        "image = numpy.zeros((2000, 2000, 3), numpy.uint8)\n"
        "before = len(os.listdir('/proc/self/task'))\n"
        "with ThreadPoolExecutor(3) as pool:\n"
        "    list(pool.map(lambda _: resize(image, 1000), range(6)))\n"
        "    print(len(os.listdir('/proc/self/task')) - before)\n"
    )
    output = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert int(output.stdout) <= 3


def test_decoding_and_inspecting_do_not_import_torch() -> None:
    script = "import sys, pipeline.images.inspect; print('torch' in sys.modules)"
    output = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert output.stdout.strip() == "False"


def test_preprocessing_name_holds_the_resizer() -> None:
    assert preprocessing_name("pillow") == "resize bicubic pillow, ImageNet normalisation"
    assert preprocessing_name() == preprocessing_name("torch") != preprocessing_name("pillow")


@pytest.mark.parametrize("by", RESIZERS)
def test_resize_to_the_same_size_changes_nothing(by: Resizer) -> None:
    assert np.array_equal(resize(noise(16, 16), 16, by), noise(16, 16))
