"""GeoTIFFs from anywhere: tiles, or a rejection, whatever sizes and georeference a header has."""

import io
import struct
import warnings
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from hypothesis import given
from hypothesis import strategies as st
from rasterio.transform import Affine

from pipeline.core.errors import InputError
from pipeline.core.records import ImageRecord, Rejection, Scanned
from pipeline.images.decode import DecodeError
from pipeline.sources.geotiff import GeoTiff
from tests.fuzz.bounds import bounded, examples
from tests.fuzz.hostile import damaged

KINDS: dict[str, dict[str, Any]] = {
    "grey": {"count": 1, "dtype": "uint8"},
    "rgb": {"count": 3, "dtype": "uint8"},
    "rgba": {"count": 4, "dtype": "uint8"},
    "float with nodata": {"count": 1, "dtype": "float32", "nodata": -1},
    "16 bits": {"count": 1, "dtype": "uint16"},
    "complex": {"count": 1, "dtype": "complex64"},
    "double": {"count": 3, "dtype": "float64"},
    "int8": {"count": 1, "dtype": "int8"},
    "complex of integers": {"count": 1, "dtype": "complex_int16"},
    "tiled": {
        "count": 3,
        "dtype": "uint8",
        "tiled": True,
        "blockxsize": 16,
        "blockysize": 16,
        "compress": "deflate",
    },
    "jpeg": {"count": 3, "dtype": "uint8", "compress": "jpeg", "photometric": "ycbcr"},
    "lzw": {"count": 1, "dtype": "uint8", "compress": "lzw"},
    "palette": {"count": 1, "dtype": "uint8", "photometric": "palette"},
}
WGS84 = Affine(1e-5, 0, 8.5, 0, -1e-5, 47.5)


def mosaic(
    path: Path, transform: Affine = WGS84, crs: Any = "EPSG:4326", side: int = 48, **kind: Any
) -> None:
    path.unlink(missing_ok=True)  # a hostile one of this name would be looked at first
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with rasterio.open(
            path, "w", driver="GTiff", width=side, height=side, transform=transform, crs=crs, **kind
        ) as opened:
            rng = np.random.default_rng(0)
            for band in range(1, kind["count"] + 1):
                if kind["dtype"] != "complex_int16":
                    opened.write(rng.integers(0, 100, (side, side)).astype(kind["dtype"]), band)
            if kind.get("photometric") == "palette":
                opened.write_colormap(1, {value: (value, 0, 0, 255) for value in range(256)})


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    with rasterio.Env(GDAL_CACHEMAX=64):
        yield tmp_path_factory.mktemp("mosaics")


@cache
def valid(kind: str, folder: Path) -> bytes:
    mosaic(folder / "made.tif", **KINDS[kind])
    data = (folder / "made.tif").read_bytes()
    (folder / "made.tif").unlink()
    return data


def tiles(path: Path, source: GeoTiff, most: int = 3) -> list[Scanned]:
    """What is found; the first tiles are cut and encoded."""
    found: list[Scanned] = []
    with bounded(InputError):
        found += source.scan(str(path))
    for record in [one for one in found if isinstance(one, ImageRecord)][:most]:
        assert record.geotag is not None
        assert abs(record.geotag.lat) <= 90
        with bounded(DecodeError):
            source.read(record)
    return found


SOURCES = [
    {"tile_pixels": 16},
    {"tile_m": 20.0, "output_pixels": 16},
    {"tile_pixels": 20, "overlap": 0.5, "max_nodata": 0.0},
    {"tile_pixels": 48, "crs": "EPSG:3857"},
]


@given(st.data(), st.sampled_from(list(KINDS)), st.sampled_from(SOURCES))
@examples(120)
def test_damaged_mosaic_is_read_or_rejected(
    folder: Path, data: st.DataObject, kind: str, source: dict[str, Any]
) -> None:
    content = data.draw(damaged(valid(kind, folder), head=400))
    for path in (folder / "damaged.tif", folder / "damaged.tif.aux.xml"):
        path.unlink(missing_ok=True)
    (folder / "damaged.tif").write_bytes(content)
    tiles(folder / "damaged.tif", GeoTiff(**source))


word = st.sampled_from(
    [0, 1, 2, 3, 4, 8, 16, 255, 256, 65535, 65536, 100_000, 2**31 - 1, 2**31, 2**32 - 1]
)


@given(
    st.dictionaries(
        st.sampled_from(
            [
                256,
                257,
                258,
                259,
                262,
                273,
                277,
                278,
                279,
                284,
                317,
                320,
                322,
                323,
                324,
                325,
                330,
                338,
                339,
                33550,
                33922,
                34264,
                34735,
                42112,
                42113,
            ]
        ),
        st.tuples(st.integers(1, 12), word, word),
        max_size=12,
    ),
    st.data(),
)
@examples(120)
def test_tiff_header_of_any_entries_is_bounded(
    folder: Path, entries: dict[int, tuple[int, int, int]], data: st.DataObject
) -> None:
    """Tags of a mosaic with any type, count and value: gigantic sides, strips beyond the file,
    directories that lead in circles."""
    base = {
        256: (4, 1, 64),
        257: (4, 1, 64),
        258: (3, 1, 8),
        259: (3, 1, 1),
        262: (3, 1, 1),
        273: (4, 1, 8),
        277: (3, 1, 1),
        278: (4, 1, 64),
        279: (4, 1, 4096),
    }
    content = base | entries
    scale = {33550: (12, 3, 1000), 33922: (12, 6, 1024)}
    content = scale | content if data.draw(st.booleans()) else content
    directory = struct.pack("<H", len(content)) + b"".join(
        struct.pack("<HHII", tag, *value) for tag, value in sorted(content.items())
    )
    following = data.draw(st.sampled_from([0, 8, 9, 1 << 31, 8 + len(directory)]))
    block = (b"II*\0" + struct.pack("<I", 8) + directory + struct.pack("<I", following)).ljust(
        1000, b"\0"
    )
    block += struct.pack("<9d", 1.0, 1.0, 0, 0, 0, 0, 8.5, 47.5, 0) + bytes(4000)
    (folder / "made.tif").write_bytes(block)
    tiles(folder / "made.tif", GeoTiff(tile_pixels=data.draw(st.sampled_from([16, 512, 10**6]))))


NUMBERS = [0.0, 1e-300, -1e-300, 1e-9, 1.0, -1.0, 1e9, 1e300, float("inf"), float("nan")]


@given(
    st.lists(st.sampled_from(NUMBERS), min_size=6, max_size=6),
    st.sampled_from(
        [
            "EPSG:4326",
            "EPSG:32632",
            "EPSG:3857",
            "EPSG:4978",
            "EPSG:5703",
            None,
            'LOCAL_CS["x"]',
            "EPSG:2180",
        ]
    ),
    st.sampled_from(SOURCES),
)
@examples(80)
def test_mosaic_of_any_georeference_is_read_or_rejected(
    folder: Path, six: list[float], crs: str | None, source: dict[str, Any]
) -> None:
    path = folder / "anywhere.tif"
    for old in (path, folder / "anywhere.tif.aux.xml"):
        old.unlink(missing_ok=True)
    try:
        mosaic(path, Affine(*six), crs, **KINDS["grey"])
    except Exception:  # rasterio's own opinion of what it is to write
        return
    tiles(path, GeoTiff(**source))


def sparse(path: Path, side: int) -> None:
    mosaic(path, count=1, dtype="uint8", side=64, tiled=True, blockxsize=16, blockysize=16)
    path.unlink()
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        width=side,
        height=side,
        count=3,
        dtype="uint8",
        transform=WGS84,
        crs="EPSG:4326",
        sparse_ok=True,
        tiled=True,
        blockxsize=4096,
        blockysize=4096,
        bigtiff="yes",
    ):
        pass


@pytest.mark.parametrize(("side", "source", "reason"), [
    (400_000, {"tile_pixels": 16}, "too many tiles"),
    (400_000, {"tile_pixels": 300_000}, "absurd dimensions"),
    (400_000, {"tile_pixels": 60_000}, "absurd dimensions"),
    (400_000, {"tile_pixels": 512, "overlap": 0.9999}, "too many tiles"),
])  # fmt: skip
def test_huge_sparse_mosaic_is_rejected_at_once(
    folder: Path, side: int, source: dict[str, Any], reason: str
) -> None:
    sparse(folder / "sparse.tif", side)
    [refused] = tiles(folder / "sparse.tif", GeoTiff(**source))
    assert isinstance(refused, Rejection)
    assert refused.reason == reason


@pytest.mark.parametrize(
    "flags",
    [
        {"tile_m": float("inf")},
        {"tile_m": 1e-300},
        {"tile_m": 1e300},
        {"overlap": float("nan")},
        {"stretch": (float("nan"), 1.0)},
        {"stretch": (0.0, float("inf"))},
        {"output_pixels": 10**9},
        {"tile_pixels": 10**30},
        {"max_nodata": float("nan")},
        {"crs": "\0"},
        {"crs": "x" * 2000},
        {"crs": "/etc/passwd"},
        {"crs": "http://127.0.0.1:1/x"},
    ],
)
def test_invalid_tiling_setting_is_rejected(folder: Path, flags: dict[str, Any]) -> None:
    (folder / "made.tif").write_bytes(valid("rgb", folder))
    with bounded(InputError):
        tiles(folder / "made.tif", GeoTiff(**flags))


def test_rare_photometric_is_read_or_rejected(folder: Path) -> None:
    stream = io.BytesIO(valid("grey", folder))
    data = bytearray(stream.getvalue())
    for photometric in (3, 4, 5, 6, 8, 9, 32803, 34892):
        at = data.find(struct.pack("<HHI", 262, 3, 1))
        data[at + 8 : at + 10] = struct.pack("<H", photometric)
        (folder / "odd.tif").write_bytes(bytes(data))
        tiles(folder / "odd.tif", GeoTiff(tile_pixels=16))
