"""Files of any name: a terminal shows their names as text, and no file is packed elsewhere."""

import io
import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from jobs.command_line import cli
from pipeline.core import progress as progress_module
from pipeline.core.errors import Incomplete, InputError
from pipeline.core.progress import CONTROL_CHARACTERS, console, escape_controls, progress, results
from pipeline.core.rejections import REJECTED_FILE
from pipeline.locate.photo_files import find_photos
from pipeline.shards.manifest import read_manifest
from pipeline.shards.pack import pack
from pipeline.shards.settings import PackingSettings
from pipeline.sources.photos import Photos
from pipeline.sources.university1652 import University1652
from tests.fuzz.bounds import bounded, examples
from tests.fuzz.hostile import NAMES

text = st.text(max_size=30) | st.sampled_from(NAMES)


@given(text)
@examples(100)
def test_console_prints_names_as_text(name: str) -> None:
    assert not CONTROL_CHARACTERS.search(escape_controls(name))
    for each in (console, results):
        with each.capture() as captured:
            each.print(name, soft_wrap=True)
        assert (
            captured.get() == escape_controls(name).expandtabs(8) + "\n"
            or "\t" in name
            or "\n" in name
        )


@given(text)
@examples(30)
def test_progress_bar_shows_names_unchanged(name: str) -> None:
    stream = io.StringIO()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            progress_module,
            "console",
            progress_module._PlainConsole(file=stream, force_terminal=True, width=200),
        )
        with progress(2, name) as meter:
            meter.advance(1, fact=name)
            meter.note(name)
    assert "\x07" not in stream.getvalue()


@pytest.mark.parametrize("name", [name for name in NAMES if name.isprintable()])
def test_error_is_one_line_for_any_name(
    name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def job() -> None:
        raise InputError(f"no file {name}\n; expected one")

    monkeypatch.setattr("sys.argv", ["job"])
    with pytest.raises(SystemExit) as ended:
        cli.run(job)
    assert ended.value.code == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert escape_controls(name) in message


def raw(name: str) -> bytes:
    return name.encode(
        "utf-8",
        "surrogateescape"
        if all(ord(c) >= 0xDC80 for c in name if 0xD800 <= ord(c) <= 0xDFFF)
        else "surrogatepass",
    )


FILES = [
    raw(name)
    for name in NAMES
    if name not in ("", ".", "..") and "/" not in name and "\0" not in name and len(raw(name)) < 200
]


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Photos in folders called each of these, called each of these."""
    root = tmp_path_factory.mktemp("names") / "world"
    for number, name in enumerate(FILES):
        stream = io.BytesIO()
        Image.new("RGB", (16, 16), (number, 0, 0)).save(stream, "JPEG")
        folder = os.path.join(os.fsencode(root), b"test", b"query_drone", name)
        os.makedirs(folder, exist_ok=True)
        with open(os.path.join(folder, name + b".jpg"), "wb") as file:
            file.write(stream.getvalue())
    return root


@pytest.mark.parametrize("source", [Photos(), University1652()])
def test_files_of_any_name_are_packed_or_rejected(
    source: Photos | University1652, world: Path, tmp_path: Path
) -> None:
    out = tmp_path / "shards"
    with bounded(InputError, Incomplete):
        pack(source, PackingSettings(root=str(world), out=str(out), workers=0, max_bad_fraction=1))
        packed = sum(shard.samples for shard in read_manifest(str(out)).shards)
        assert packed >= len(FILES) - 6
    assert (out / REJECTED_FILE).exists()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["shards"]
    assert len(find_photos([str(world)])) == len(FILES)
