"""Decoding and resizing against Pillow, orientation and augmentation against pictures whose every
pixel says where it was.

Shapes: H x W pixels.
"""

import io
import struct
import subprocess
import sys
import zlib
from contextlib import suppress
from math import atan2, degrees
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image, ImageOps

from pipeline.core.records import View
from pipeline.images.decode import DecodeError, Pixels, decode
from pipeline.images.transforms import Augmentation, Resizer, augment, preprocessing_name, resize

ROOT = Path(__file__).parents[2]
RESIZERS: tuple[Resizer, ...] = ("torch", "pillow")


def noise(height: int = 37, width: int = 50) -> Pixels:
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)


def encoded(image: Image.Image, form: str, **options: object) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, form, **options)
    return buffer.getvalue()


PHOTO = Image.fromarray(noise())
FORMS = {
    "jpeg": encoded(PHOTO, "JPEG"),
    "jpeg of full colour": encoded(PHOTO, "JPEG", subsampling=0, quality=95),
    "jpeg of half colour": encoded(PHOTO, "JPEG", subsampling=1),
    "progressive jpeg": encoded(PHOTO, "JPEG", progressive=True),
    "grey jpeg": encoded(PHOTO.convert("L"), "JPEG"),
    "cmyk jpeg": encoded(PHOTO.convert("CMYK"), "JPEG"),
    "png": encoded(PHOTO, "PNG"),
    "grey png": encoded(PHOTO.convert("L"), "PNG"),
    "black and white png": encoded(PHOTO.convert("1"), "PNG"),
    "palette png": encoded(PHOTO.convert("P"), "PNG"),
    "rgba png": encoded(PHOTO.convert("RGBA"), "PNG"),
    "grey png with alpha": encoded(PHOTO.convert("LA"), "PNG"),
    "gif": encoded(PHOTO.convert("P"), "GIF"),
    "bmp": encoded(PHOTO, "BMP"),
    "tiff": encoded(PHOTO, "TIFF", compression="tiff_lzw"),
    "webp": encoded(PHOTO, "WEBP", lossless=True),
}


@pytest.mark.parametrize("data", FORMS.values(), ids=FORMS)
def test_every_kind_of_file_decodes_to_the_pixels_that_pillow_gives(data: bytes) -> None:
    found_HW3 = decode(data)
    assert found_HW3.dtype == np.uint8
    with Image.open(io.BytesIO(data)) as image:
        assert np.array_equal(found_HW3, np.asarray(image.convert("RGB")))


def test_a_palette_with_transparency_decodes_without_a_warning_to_its_colours() -> None:
    data = encoded(PHOTO.convert("P"), "PNG", transparency=bytes([0, 128] * 20))
    assert np.array_equal(decode(data), np.asarray(PHOTO.convert("P").convert("RGB")))


@pytest.mark.parametrize("form", ["PNG", "TIFF"])
def test_sixteen_bits_a_pixel_keep_their_upper_eight(form: str) -> None:
    deep_HW = np.array([[0, 255, 256], [0x1234, 0x80FF, 0xFFFF]], np.uint16)
    found_HW3 = decode(encoded(Image.fromarray(deep_HW), form))
    assert found_HW3.dtype == np.uint8
    for channel in range(3):
        assert found_HW3[:, :, channel].tolist() == [[0, 0, 1], [0x12, 0x80, 0xFF]]


A, B, C, D, E, F = ((value, value, value) for value in (10, 50, 90, 130, 170, 210))
STORED = [[A, B, C], [D, E, F]]
UPRIGHT = {
    1: [[A, B, C], [D, E, F]],
    2: [[C, B, A], [F, E, D]],  # mirrored
    3: [[F, E, D], [C, B, A]],  # upside down
    4: [[D, E, F], [A, B, C]],
    5: [[A, D], [B, E], [C, F]],
    6: [[D, A], [E, B], [F, C]],  # to be turned clockwise
    7: [[F, C], [E, B], [D, A]],
    8: [[C, F], [B, E], [A, D]],  # to be turned anticlockwise
}


def exif(orientation: int) -> Image.Exif:
    tags = Image.Exif()
    tags[0x0112] = orientation
    return tags


@pytest.mark.parametrize("orientation", UPRIGHT)
@pytest.mark.parametrize(
    ("form", "mode"), [("PNG", "RGB"), ("PNG", "P"), ("TIFF", "RGB"), ("WEBP", "RGB")]
)
def test_an_image_comes_upright_as_its_exif_orientation_says(
    orientation: int, form: str, mode: str
) -> None:
    stored = Image.fromarray(np.array(STORED, np.uint8))
    if mode == "P":
        stored = stored.quantize(6)  # as many colours as it has
    options = {"lossless": True} if form == "WEBP" else {}
    data = encoded(stored, form, exif=exif(orientation), **options)
    assert np.array_equal(decode(data), np.array(UPRIGHT[orientation], np.uint8))


@pytest.mark.parametrize("orientation", UPRIGHT)
def test_a_photo_from_a_camera_held_sideways_comes_upright(orientation: int) -> None:
    large_HW3 = np.kron(np.array(STORED, np.uint8), np.ones((16, 16, 1), np.uint8))  # JPEG's blocks
    found_HW3 = decode(
        encoded(Image.fromarray(large_HW3), "JPEG", quality=95, exif=exif(orientation))
    )
    expected_HW3 = np.array(UPRIGHT[orientation], np.int64)
    assert np.abs(found_HW3[8::16, 8::16] - expected_HW3).max() <= 2


@pytest.mark.parametrize("orientation", UPRIGHT)
@pytest.mark.parametrize(
    ("mode", "form", "options"),
    [
        ("RGB", "JPEG", {}),
        ("RGB", "JPEG", {"progressive": True}),
        ("L", "JPEG", {}),
        ("CMYK", "JPEG", {}),
        (
            "RGB",
            "MPO",
            {"save_all": True, "append_images": [PHOTO.resize((20, 20))]},
        ),  # a JPEG that another follows
    ],
)
def test_a_turned_photo_has_the_pixels_that_pillow_gives(
    orientation: int, mode: str, form: str, options: dict[str, object]
) -> None:
    data = encoded(PHOTO.convert(mode), form, exif=exif(orientation), **options)
    with Image.open(io.BytesIO(data)) as image:
        assert image.format == form
        expected_HW3 = np.asarray(ImageOps.exif_transpose(image).convert("RGB"))
    found_HW3 = decode(data)
    assert np.array_equal(found_HW3, expected_HW3)
    assert found_HW3.flags.c_contiguous


@pytest.mark.parametrize("orientation", [0, 9, 255])
def test_an_orientation_without_a_meaning_is_passed_over(orientation: int) -> None:
    data = encoded(PHOTO, "PNG", exif=exif(orientation))
    assert np.array_equal(decode(data), noise())


@pytest.mark.parametrize("kind", [2, 7, 12])
def test_a_photo_is_turned_though_its_camera_gave_another_tag_a_type_that_is_not_its_own(
    kind: int,
) -> None:
    orientation = struct.pack("<HHII", 0x0112, 3, 1, 6)
    resolution = struct.pack("<HHII", 0x011A, kind, 1, 40)  # a rational by the standard
    tags = b"Exif\0\0II*\0\x08\0\0\0\x02\0" + orientation + resolution + bytes(60)
    assert decode(encoded(PHOTO, "JPEG", exif=tags)).shape == (50, 37, 3)


def png(height: int, width: int) -> bytes:
    """A small PNG file that says it has that size."""
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(bytes(100))), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        for kind, body in chunks
    )


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "empty file"),
        (b"<html>404 Not Found</html>", "not an image"),
        (bytes(1000), "not an image"),
        (FORMS["jpeg"][:400], "damaged image"),
        (FORMS["jpeg"][:-200], "damaged image"),
        (FORMS["cmyk jpeg"][:-200], "damaged image"),
        (FORMS["progressive jpeg"][:-200], "damaged image"),
        (FORMS["png"][:-200], "damaged image"),
        (FORMS["tiff"][: len(FORMS["tiff"]) // 2], "damaged image"),
        (FORMS["webp"][:-200], "damaged image"),
        (png(100_000, 100_000), "too many pixels"),
    ],
)
def test_what_is_no_whole_image_is_refused_for_a_countable_reason(data: bytes, reason: str) -> None:
    with pytest.raises(DecodeError) as caught:
        decode(data)
    assert caught.value.reason == reason
    assert str(caught.value) == f"{reason}: {caught.value.found}"
    assert caught.value.found


@pytest.mark.filterwarnings("ignore")  # of Pillow, over metadata that makes no sense
@settings(max_examples=150)
@given(
    data=st.sampled_from(
        [FORMS["jpeg"], FORMS["png"], FORMS["tiff"], encoded(PHOTO, "JPEG", exif=exif(6))]
    ),
    faults=st.lists(st.tuples(st.integers(0, 400), st.integers(0, 255)), max_size=4),
    cut=st.integers(0, 8000),
)
def test_no_damage_raises_anything_but_a_decode_error(
    data: bytes, faults: list[tuple[int, int]], cut: int
) -> None:
    damaged = bytearray(data)
    for position, value in faults:
        damaged[position] = value
    with suppress(DecodeError):
        assert decode(bytes(damaged[: max(1, len(damaged) - cut)])).shape[2] == 3


@pytest.mark.parametrize(("height", "width"), [(37, 50), (16, 16), (3, 2), (100, 64)])
def test_resizing_by_pillow_is_its_antialiased_bicubic(height: int, width: int) -> None:
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
def test_resizing_by_torch_is_within_one_grey_level_of_pillows_and_hardly_ever_two(
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
def test_photos_made_small_by_torch_are_within_one_grey_level_of_pillows(
    height: int, width: int, size: int
) -> None:
    image_HW3 = noise(height, width)
    by_torch, by_pillow = (resize(image_HW3, size, by).astype(np.int64) for by in RESIZERS)
    assert np.abs(by_torch - by_pillow).max() <= 1


def test_an_image_resized_by_torch_is_one_block_of_memory_of_which_nobody_else_knows() -> None:
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
def test_threads_that_resize_start_no_threads_of_their_own() -> None:
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
    told = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert int(told.stdout) <= 3


def test_decoding_and_inspecting_do_not_wait_for_torch() -> None:
    script = "import sys, pipeline.images.inspect; print('torch' in sys.modules)"
    told = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert told.stdout.strip() == "False"


def test_the_preprocessing_says_who_resized_and_pillows_is_what_it_always_was() -> None:
    assert preprocessing_name("pillow") == "resize bicubic pillow, ImageNet normalisation"
    assert preprocessing_name() == preprocessing_name("torch") != preprocessing_name("pillow")


@pytest.mark.parametrize("by", RESIZERS)
def test_an_image_that_has_its_size_is_left_as_it_is(by: Resizer) -> None:
    assert np.array_equal(resize(noise(16, 16), 16, by), noise(16, 16))


SIZE, PAD = 12, 3
SIDE = np.arange(SIZE)
MAP: Pixels = np.stack(
    [*np.meshgrid(SIDE, SIDE, indexing="ij"), np.full((SIZE, SIZE), 9)], axis=2
).astype(np.uint8)
"An image whose pixels hold their row and column."
BARE = Augmentation(pad=PAD, rotation=0, mirror=False)


def drawn(view: View, settings: Augmentation, seeds: int, image_HW3: Pixels = MAP) -> list[Pixels]:
    return [
        augment(image_HW3, view, SIZE, settings, np.random.default_rng(seed))
        for seed in range(seeds)
    ]


def shifted(down: int, right: int) -> Pixels:
    """The map moved over a ground that repeats its edge."""
    rows, columns = (np.clip(SIDE + by, 0, SIZE - 1) for by in (down, right))
    return MAP[rows][:, columns]


def test_the_settings_by_default_are_the_papers() -> None:
    assert Augmentation() == Augmentation(pad=10, rotation=90.0, mirror=True)


def test_a_crop_lies_anywhere_in_the_image_padded_by_its_edge_and_nowhere_else() -> None:
    possible = {
        shifted(down, right).tobytes(): (down, right)
        for down in range(-PAD, PAD + 1)
        for right in range(-PAD, PAD + 1)
    }
    seen = {
        possible[np.ascontiguousarray(image_HW3).tobytes()]
        for image_HW3 in drawn(View.DRONE, BARE, 400)
    }
    assert {down for down, _ in seen} == {right for _, right in seen} == set(range(-PAD, PAD + 1))
    assert len(seen) == 49


def test_a_drones_image_is_never_turned_and_mirrored_half_the_time() -> None:
    mirrored = 0
    for image_HW3 in drawn(View.DRONE, Augmentation(pad=PAD), 400):
        leftward = int(image_HW3[0, 0, 1]) > int(image_HW3[0, -1, 1])
        mirrored += leftward
        straight_HW3 = image_HW3[:, ::-1] if leftward else image_HW3
        assert (straight_HW3 == straight_HW3[:, :1])[:, :, 0].all()  # rows stay rows
        assert (straight_HW3 == straight_HW3[:1])[:, :, 1].all()
    assert 150 < mirrored < 250


def test_without_padding_turning_and_mirroring_an_image_is_only_resized() -> None:
    [image_HW3] = drawn(View.SATELLITE, Augmentation(pad=0, rotation=0, mirror=False), 1, noise())
    assert np.array_equal(image_HW3, resize(noise(), SIZE))


def test_a_satellites_image_is_turned_by_every_angle_up_to_ninety_degrees_either_way() -> None:
    size, centre = 65, 32
    field_HW3 = np.zeros((size, size, 3), np.uint8)
    field_HW3[centre - 2 : centre + 3, centre + 20 : centre + 25] = 255  # a mark to the east
    angles = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        image_HW3 = augment(field_HW3, View.SATELLITE, size, Augmentation(pad=0, mirror=False), rng)
        rows, columns = np.nonzero(image_HW3[:, :, 0])
        angles.append(degrees(atan2(centre - rows.mean(), columns.mean() - centre)))
    assert all(-92 < angle < 92 for angle in angles)
    counts = np.histogram(angles, bins=[-92, -60, -30, 0, 30, 60, 92])[0]
    assert (counts > 15).all()


def test_the_ground_is_padded_before_it_is_turned_and_turned_corners_are_black() -> None:
    white_HW3 = np.full((SIZE, SIZE, 3), 255, np.uint8)
    for image_HW3 in drawn(View.SATELLITE, Augmentation(pad=PAD), 50, white_HW3):
        assert set(np.unique(image_HW3).tolist()) <= {0, 255}
    assert any(
        (image_HW3 == 0).any()
        for image_HW3 in drawn(View.SATELLITE, Augmentation(pad=PAD), 50, white_HW3)
    )
    for image_HW3 in drawn(View.SATELLITE, Augmentation(pad=40), 50, white_HW3):
        assert image_HW3[4:8, 4:8].all() or (image_HW3 == 0).any()
    assert all(
        (image_HW3 == 255).all()
        for image_HW3 in drawn(View.DRONE, Augmentation(pad=PAD), 50, white_HW3)
    )


@pytest.mark.parametrize("view", [View.DRONE, View.SATELLITE])
def test_augmentation_is_decided_by_its_random_numbers_alone(view: View) -> None:
    once, again = (drawn(view, Augmentation(pad=PAD), 20) for _ in range(2))
    assert all(np.array_equal(one, other) for one, other in zip(once, again, strict=True))
    assert len({image_HW3.tobytes() for image_HW3 in once}) > 10


def test_an_augmented_image_is_one_block_of_memory_of_the_networks_size() -> None:
    for view in (View.DRONE, View.SATELLITE):
        for image_HW3 in drawn(view, Augmentation(), 4, noise()):
            assert image_HW3.shape == (SIZE, SIZE, 3)
            assert image_HW3.dtype == np.uint8
            assert image_HW3.flags.c_contiguous
