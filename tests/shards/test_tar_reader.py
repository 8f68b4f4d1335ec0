"""Tars as they come: whole, cut off anywhere, and hostile."""

import io
import tarfile
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.core.errors import InputError
from pipeline.core.records import Split, View
from pipeline.shards.manifest import read_manifest
from pipeline.shards.samples import read_locations, read_samples
from pipeline.shards.tar_reader import read_members, read_tar


def tar_of(members: dict[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as tar:
        for name, data in members.items():
            member = tarfile.TarInfo(name)
            member.size = len(data)
            tar.addfile(member, io.BytesIO(data))
    return buffer.getvalue()


MEMBERS = {
    "a/0.jpg": b"picture 0",
    "a/0.json": b"{}",
    "a/0.pyd": b"cos\nsystem\n",
    "b/0.x.jpg": b"not an image's ending",
    "b/0.PNG": b"picture 1",
    "b/0.cls": b"7",
    "./c.webp": b"picture 2" * 100,
    "readme": b"",
    "d.txt": b"a caption",
}
FOUND = [
    ("a/0", {"jpg": b"picture 0", "json": b"{}"}),
    ("b/0", {"png": b"picture 1", "cls": b"7"}),
    ("c", {"webp": b"picture 2" * 100}),
]


def test_members_are_grouped_by_their_names_and_those_of_other_endings_are_not_read(
    tmp_path: Path,
) -> None:
    (tmp_path / "x.tar").write_bytes(tar_of(MEMBERS))
    assert list(read_tar(str(tmp_path / "x.tar"))) == FOUND
    assert list(read_tar(str(tmp_path / "x.tar"), ("json",))) == [("a/0", {"json": b"{}"})]


def test_long_names_and_folders_and_links_are_no_obstacle() -> None:
    long = "folder/" * 40 + "0.jpg"
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=tarfile.PAX_FORMAT) as tar:
        folder, link, member = (
            tarfile.TarInfo("folder"),
            tarfile.TarInfo("0.jpg"),
            tarfile.TarInfo(long),
        )
        folder.type, link.type, link.linkname, member.size = (
            tarfile.DIRTYPE,
            tarfile.SYMTYPE,
            "/etc/passwd",
            3,
        )
        tar.addfile(folder)
        tar.addfile(link)
        tar.addfile(member, io.BytesIO(b"abc"))
    buffer.seek(0)
    assert list(read_members(buffer, "it", ("jpg",))) == [
        (long.removesuffix(".jpg"), {"jpg": b"abc"})
    ]


@pytest.mark.parametrize(
    "name", ["/etc/0.jpg", "../0.jpg", "a/../../0.jpg", "a/..", "..\\0.jpg", "C:\\0.jpg"]
)
def test_a_name_that_leads_out_of_the_tar_is_refused_with_the_tars(
    name: str, tmp_path: Path
) -> None:
    path = tmp_path / "x.tar"
    path.write_bytes(tar_of({"0.jpg": b"x", name: b"y"}))
    with pytest.raises(
        InputError,
        match=r"x\.tar holds a member named '.*0\.jpg|x\.tar holds a member named 'a/\.\.'",
    ):
        list(read_tar(str(path)))


WHOLE = tar_of(MEMBERS)
END = WHOLE.rindex(b"a caption") + 512 - WHOLE.rindex(b"a caption") % 512
"Where the end marker begins."


@settings(max_examples=200)
@given(cut=st.integers(0, END + 511))
def test_a_tar_that_is_cut_off_anywhere_is_seen_even_between_two_members(cut: int) -> None:
    with pytest.raises(
        InputError, match=r"it\.tar is cut off or damaged after \d samples .*; copy it again"
    ):
        list(read_members(io.BytesIO(WHOLE[:cut]), "it.tar", ("jpg", "png", "webp")))


def test_a_header_that_was_overwritten_is_not_taken_for_the_end() -> None:
    data = bytearray(WHOLE)
    second = WHOLE.index(b"b/0.PNG")
    data[second : second + 3] = b"???"
    with pytest.raises(
        InputError, match=r"it\.tar is cut off or damaged after 0 samples \(bad checksum\)"
    ):
        list(read_members(io.BytesIO(data), "it.tar", ("jpg", "png", "webp")))


def test_a_shard_of_ours_that_is_cut_off_or_hostile_is_named(
    tiny_shards: str, tmp_path: Path
) -> None:
    name = read_manifest(tiny_shards).of(Split.TRAIN, View.DRONE)[0].name
    data = (Path(tiny_shards) / f"{name}.tar").read_bytes()
    (tmp_path / f"{name}.tar").write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match=rf"{name}\.tar is cut off"):
        list(read_samples(str(tmp_path / f"{name}.tar")))
    with pytest.raises(InputError, match=rf"{name}\.tar is cut off"):
        list(read_locations(str(tmp_path / f"{name}.tar")))
    (tmp_path / f"{name}.tar").write_bytes(b"no tar at all" * 100)
    with pytest.raises(InputError, match=rf"{name}\.tar is cut off or damaged"):
        list(read_samples(str(tmp_path / f"{name}.tar")))


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")
def test_hugging_faces_datasets_reads_a_shard_of_ours(tiny_shards: str, tmp_path: Path) -> None:
    # Optional: it brings a hundred megabytes along, for this one test.
    datasets = pytest.importorskip(
        "datasets", reason="Hugging Face datasets is not among the development dependencies"
    )
    name = read_manifest(tiny_shards).of(Split.TRAIN, View.DRONE)[0].name
    found = datasets.load_dataset(
        "webdataset", data_files=f"{tiny_shards}/{name}.tar", split="train", cache_dir=str(tmp_path)
    )
    ours = list(read_samples(f"{tiny_shards}/{name}.tar"))
    assert [row["__key__"] for row in found] == [sample.key for sample in ours]
    assert [row["json"]["location"] for row in found] == [
        sample.metadata["location"] for sample in ours
    ]
