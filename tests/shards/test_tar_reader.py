"""Tars as others send them: complete, cut anywhere, and hostile."""

import io
import subprocess
import sys
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


def test_read_tar_groups_members_and_skips_others(
    tmp_path: Path,
) -> None:
    (tmp_path / "x.tar").write_bytes(tar_of(MEMBERS))
    assert list(read_tar(str(tmp_path / "x.tar"))) == FOUND
    assert list(read_tar(str(tmp_path / "x.tar"), ("json",))) == [("a/0", {"json": b"{}"})]


def test_read_members_long_names_folders_and_links() -> None:
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
def test_read_tar_refuses_names_that_lead_out(name: str, tmp_path: Path) -> None:
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
def test_read_members_refuses_a_tar_cut_anywhere(cut: int) -> None:
    with pytest.raises(
        InputError, match=r"it\.tar is cut off or damaged after \d samples .*; copy it again"
    ):
        list(read_members(io.BytesIO(WHOLE[:cut]), "it.tar", ("jpg", "png", "webp")))


def test_read_members_refuses_an_overwritten_header() -> None:
    data = bytearray(WHOLE)
    second = WHOLE.index(b"b/0.PNG")
    data[second : second + 3] = b"???"
    with pytest.raises(
        InputError, match=r"it\.tar is cut off or damaged after 0 samples \(bad checksum\)"
    ):
        list(read_members(io.BytesIO(data), "it.tar", ("jpg", "png", "webp")))


SUFFIXES = ("jpg", "png", "webp")


def refused(data: bytes) -> str:
    """The reason in the sentence with which a tar is refused."""
    with pytest.raises(
        InputError, match=r"it\.tar is cut off or damaged after \d samples"
    ) as error:
        list(read_members(io.BytesIO(data), "it.tar", SUFFIXES))
    return str(error.value)


def test_read_members_refuses_a_zeroed_header() -> None:
    """tarfile, and so webdataset, ends at an empty header without an error."""
    data = bytearray(WHOLE)
    header = WHOLE.index(b"b/0.PNG")
    data[header : header + 512] = bytes(512)
    with tarfile.open(fileobj=io.BytesIO(data)) as tar:
        assert len(tar.getnames()) == 4
    assert "an empty header before its end" in refused(bytes(data))


def test_read_members_refuses_a_tar_behind_a_tar() -> None:
    assert "an empty header before its end" in refused(WHOLE + WHOLE)


def test_read_members_accepts_any_padding() -> None:
    for zeros in (512, 1024, 65_536):
        found = read_members(io.BytesIO(WHOLE[:END] + bytes(zeros)), "it.tar", SUFFIXES)
        assert [key for key, _ in found] == ["a/0", "b/0", "c"]


def pax_tar(headers: dict[str, str]) -> bytes:
    """A tar of one file behind a pax header."""
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w", format=tarfile.PAX_FORMAT) as tar:
        member = tarfile.TarInfo("0.jpg")
        member.size, member.pax_headers = 3, headers
        tar.addfile(member, io.BytesIO(b"abc"))
    return stream.getvalue()


@pytest.mark.parametrize("padding", range(440, 520, 7))
def test_read_members_refuses_sparse_across_blocks(padding: int) -> None:
    """The keyword is found wherever the border between two blocks of the header falls."""
    plain = pax_tar({"comment": "x" * padding})
    [(key, members)] = read_members(io.BytesIO(plain), "it.tar", SUFFIXES)
    assert (key, members) == ("0", {"jpg": b"abc"})
    sparse = pax_tar({"comment": "x" * padding, "GNU.sparse.size": "200000000"})
    assert "it holds a sparse file" in refused(sparse)


def test_read_members_refuses_another_size_in_a_pax_header() -> None:
    """tarfile follows this size, and the check would read other blocks as headers than it does."""
    assert "a file larger than 8 GiB" in refused(pax_tar({"size": "1536"}))


def test_read_members_refuses_a_name_like_gzip() -> None:
    """tarfile would unpack it by itself, behind the check."""
    data = bytearray(tar_of({"0.jpg": b"abc"}))
    data[:3] = b"\x1f\x8b\x08"
    checksum = sum(data[:148]) + sum(data[156:512]) + 8 * 32
    data[148:156] = b"%06o\0 " % checksum
    assert "compressed, or its first name looks like it" in refused(bytes(data))


def test_read_members_errors_do_not_name_the_stream() -> None:
    """webdataset appends the stream to the messages of errors."""
    assert "GuardedTar" not in refused(WHOLE[: END - 600])
    with pytest.raises(InputError) as error:
        list(read_members(io.BytesIO(tar_of({"../0.jpg": b"x"})), "it.tar", SUFFIXES))
    assert str(error.value).endswith("have it packed again with plain names")


@pytest.mark.slow
def test_packing_imports_neither_torch_nor_webdataset() -> None:
    code = "import sys, pipeline.shards.pack; print({'torch', 'webdataset'} & {*sys.modules})"
    command = [sys.executable, "-c", code]
    found = subprocess.run(command, capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "set()"


def test_read_samples_names_a_cut_shard(tiny_shards: str, tmp_path: Path) -> None:
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
def test_huggingface_datasets_reads_a_shard(tiny_shards: str, tmp_path: Path) -> None:
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
