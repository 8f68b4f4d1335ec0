"""Images deeper than 8 bits survive decoding: stretched, kept if they fill 16 bits, or refused.

Shapes: H x W pixels.
"""

import io
import warnings
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image, TiffImagePlugin

from pipeline.images.decode import DecodeError, decode
from pipeline.images.inspect import inspect
from pipeline.images.stretch import deep_to_8bit, stretch_of, to_8bit

RAMP = np.linspace(0, 1, 64 * 48).reshape(64, 48)


def tiff(values_HW: npt.NDArray[Any], **tags: Any) -> bytes:
    buffer = io.BytesIO()
    names = {"photometric": 262, "nodata": 42113}
    info = TiffImagePlugin.ImageFileDirectory_v2()
    for name, value in tags.items():
        info[names[name]] = value
    Image.fromarray(values_HW).save(buffer, "TIFF", tiffinfo=info)
    return buffer.getvalue()


DEEP = {
    "12 bit": (RAMP * 4095).astype(np.uint16),
    "14 bit thermal": (7000 + RAMP * 600).astype(np.uint16),
    "kelvin": (29_315 + RAMP * 2_000).astype(np.uint16),
    "counts above half": (33_000 + RAMP * 900).astype(np.uint16),
    "reflectance": RAMP.astype(np.float32),
    "degrees": (RAMP * 60 - 20).astype(np.float32),
    "32 bit": (RAMP * 1e9).astype(np.int32),
    "signed": (RAMP * 2_000 - 1_000).astype(np.int32),
}


@pytest.mark.parametrize("values_HW", DEEP.values(), ids=DEEP)
def test_decode_stretches_a_deep_band(values_HW: npt.NDArray[Any]) -> None:
    data = tiff(values_HW)
    shown_HW3 = decode(data)
    assert inspect(data) == (48, 64)
    assert (shown_HW3 == shown_HW3[:, :, :1]).all()
    shown_HW = shown_HW3[:, :, 0].astype(np.int64)
    assert len(np.unique(shown_HW)) > 200
    expected_HW = np.clip((RAMP - 0.02) / 0.96 * 255, 0, 255)
    assert np.abs(shown_HW - expected_HW).max() <= 1.5


def test_decode_keeps_the_upper_8_bits_of_full_16() -> None:
    values_HW = (RAMP * 60_000).astype(np.uint16)
    assert np.array_equal(decode(tiff(values_HW))[:, :, 0], values_HW >> 8)


@pytest.mark.parametrize("values_HW", [DEEP["12 bit"], (RAMP * 60_000).astype(np.uint16)])
def test_decode_inverts_white_is_zero(values_HW: npt.NDArray[Any]) -> None:
    plain, negative = (decode(tiff(values_HW, photometric=kind)) for kind in (1, 0))
    assert np.array_equal(negative, 255 - plain)


@pytest.mark.parametrize("nodata", [-9999.0, float("nan")])
def test_decode_shows_nodata_black_and_does_not_count_it(nodata: float) -> None:
    values_HW = RAMP.astype(np.float32)
    values_HW[:, :24] = nodata
    shown_HW = decode(tiff(values_HW, nodata=str(nodata)))[:, :, 0]
    assert not shown_HW[:, :24].any()
    assert len(np.unique(shown_HW[:, 24:])) > 150
    assert not decode(tiff(np.full((9, 9), nodata, np.float32), nodata=str(nodata))).any()


def test_decode_refuses_dark_channels_of_16_bits() -> None:
    rasterio = pytest.importorskip("rasterio")
    for factor, reason in ((4_095, "too few levels"), (60_000, None)):
        values_BHW = np.stack([(RAMP * factor).astype(np.uint16)] * 3)
        with warnings.catch_warnings(), rasterio.MemoryFile() as memory:
            warnings.simplefilter("ignore")  # an image without a position
            with memory.open(
                driver="GTiff", width=48, height=64, count=3, dtype="uint16", photometric="RGB"
            ) as target:
                target.write(values_BHW)
            data = memory.read()
        if reason is None:
            assert decode(data).max() > 200
            continue
        with pytest.raises(DecodeError, match="values fill 16 of 256 levels") as refused:
            decode(data)
        assert refused.value.reason == reason


def test_stretch_is_wide_enough_to_divide_by() -> None:
    assert stretch_of(np.array([], np.uint16)) == (0, 1)
    assert stretch_of(np.full(9, 7, np.uint16)) == (7, 8)
    low, high = stretch_of(np.full(9, 0.25, np.float32))
    assert low == 0.25 < high
    assert to_8bit(np.array([[7, 8]]), (7, 8)).tolist() == [[0, 255]]
    assert deep_to_8bit(np.full((2, 2), 9, np.uint16)).tolist() == [[0, 0], [0, 0]]


def test_decode_of_odd_metadata_prints_no_warning(
    capfd: pytest.CaptureFixture[str],
) -> None:
    """Pillow warns of it once per file, by the hundred where one camera took all photos."""
    exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x0f\x01\x02\0\xff\xff\0\0\xff\0\0\0"  # longer than it is
    buffer = io.BytesIO()
    Image.new("RGB", (16, 16)).save(buffer, "JPEG", exif=exif)
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        assert decode(buffer.getvalue()).shape == (16, 16, 3)
        assert inspect(buffer.getvalue()) == (16, 16)
    assert capfd.readouterr().err == ""
