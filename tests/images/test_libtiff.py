"""Odd TIFF files leave no lines of libtiff on the terminal, and are still refused by name."""

import io
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, features

from pipeline.images import libtiff
from pipeline.images.libtiff import silence_libtiff

SCRIPT = """
import sys
from pathlib import Path
from PIL import Image
from pipeline.images.decode import DecodeError, decode
if "decode" in sys.argv:
    for path in sys.argv[2:]:
        try:
            decode(Path(path).read_bytes())
        except DecodeError as error:
            print(error.reason)
else:
    for path in sys.argv[2:]:
        try:
            Image.open(path).load()
        except OSError:
            print("refused")
"""
pytestmark = pytest.mark.skipif(
    not (features.check("libtiff") and silence_libtiff()),
    reason="needs Linux and a Pillow that brings its own libtiff",
)


@pytest.fixture
def damaged(tmp_path: Path) -> list[str]:
    """Two TIFFs whose compressed pixels are damaged, as libtiff reports in words of its own."""
    cells = np.random.default_rng(0).integers(0, 256, size=(64, 64, 3), dtype=np.uint8)
    paths = []
    for compression in ("tiff_lzw", "tiff_adobe_deflate"):
        stream = io.BytesIO()
        Image.fromarray(cells).save(stream, "TIFF", compression=compression)
        data = bytearray(stream.getvalue())
        data[1000:1400] = b"\xff" * 400
        path = tmp_path / f"{compression}.tif"
        path.write_bytes(data)
        paths.append(str(path))
    return paths


def run(how: str, paths: list[str]) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", SCRIPT, how, *paths]
    return subprocess.run(command, capture_output=True, text=True, check=True)


def test_damaged_tiff_is_refused_without_lines_of_libtiff(damaged: list[str]) -> None:
    loud = run("pillow", damaged)
    assert loud.stderr.strip(), "otherwise there is nothing to silence"
    quiet = run("decode", damaged)
    assert quiet.stderr == ""
    assert quiet.stdout.splitlines() == ["damaged image"] * 2


def test_silence_libtiff_without_a_list_of_libraries(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(libtiff, "LOADED_LIBRARIES", tmp_path / "none")
    assert silence_libtiff.__wrapped__() == 0


def test_silence_libtiff_leaves_other_libraries_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    maps = tmp_path / "maps"
    maps.write_text(
        "7f00-7f01 r-xp 0 00:00 1  /usr/lib/libtiff.so.6\n7f00-7f01 r--p 0 00:00 1\n"
        "7f00-7f01 r-xp 0 00:00 1  /x/rasterio.libs/libtiff-1.so\n"
        f"7f00-7f01 r-xp 0 00:00 1  {tmp_path}/pillow.libs/libtiff-gone.so\n"
    )
    monkeypatch.setattr(libtiff, "LOADED_LIBRARIES", maps)
    assert silence_libtiff.__wrapped__() == 0
