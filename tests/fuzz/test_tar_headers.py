"""Tar headers and sample JSON from anywhere: samples, or a sentence why there are none."""

import io
import json
import tarfile
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.core.errors import InputError
from pipeline.core.records import Split, View
from pipeline.shards.manifest import Shard
from pipeline.shards.samples import read_locations, read_samples
from pipeline.shards.shard_set import open_or_scan
from pipeline.shards.tar_reader import read_members
from pipeline.shards.verify import check_shard
from tests.fuzz.bounds import bounded, examples
from tests.fuzz.hostile import damaged, twisted, values
from tests.fuzz.test_tars import FACTS, member, packed, read


def header(kind: bytes, size: int, name: bytes = b"0.jpg", sparse: bytes = b"") -> bytes:
    """One header with a checksum that is right; sizes beyond 8 GiB, and below 0, as GNU's tar
    writes them.
    """
    block = bytearray(tarfile.TarInfo(name.decode()).tobuf(tarfile.GNU_FORMAT))
    block[156:157] = kind
    block[124:136] = (
        b"%011o\0" % size
        if 0 <= size < 8**11
        else (b"\x80" if size >= 0 else b"\xff") + size.to_bytes(11, "big", signed=True)
    )
    block[386 : 386 + len(sparse)] = sparse
    block[148:156] = b" " * 8
    block[148:156] = b"%06o\0 " % sum(block)
    return bytes(block)


@pytest.mark.parametrize(
    "kind",
    [
        tarfile.REGTYPE,
        tarfile.GNUTYPE_LONGNAME,
        tarfile.GNUTYPE_LONGLINK,
        tarfile.XHDTYPE,
        tarfile.XGLTYPE,
        tarfile.SOLARIS_XHDTYPE,
        tarfile.DIRTYPE,
        tarfile.GNUTYPE_SPARSE,
        tarfile.SYMTYPE,
    ],
)
@pytest.mark.parametrize("size", [2**40, 2**62, 2**80, -1, -512, -(2**40), 3 << 20])
def test_tar_header_with_a_wrong_size_is_rejected(kind: bytes, size: int) -> None:
    read(header(kind, size) + bytes(4096))
    read(header(tarfile.REGTYPE, 512) + b"x" * 512 + header(kind, size) + bytes(4096))


def test_sparse_tar_member_is_rejected() -> None:
    """GNU's sparse file of old: a terabyte of nothing in a kilobyte."""
    sparse = (
        b"%011o\0%011o\0" % (0, 0) + bytes(72) + b"\0" + (b"\x80" + (2**40).to_bytes(11, "big"))
    )
    read(header(tarfile.GNUTYPE_SPARSE, 0, sparse=sparse) + bytes(1024))
    for pax in (
        {"GNU.sparse.size": str(2**40), "GNU.sparse.map": "0,0"},
        {
            "GNU.sparse.major": "0",
            "GNU.sparse.minor": "1",
            "GNU.sparse.realsize": str(2**40),
            "GNU.sparse.map": "0,1",
        },
    ):
        read(packed([member("0.jpg", b"x", pax=pax)], tarfile.PAX_FORMAT))
    with pytest.raises(InputError, match="sparse"):
        list(
            read_members(
                io.BytesIO(header(tarfile.GNUTYPE_SPARSE, 0, sparse=sparse) + bytes(1024)),
                "it.tar",
                ("jpg",),
            )
        )


@pytest.mark.parametrize("kind", [tarfile.GNUTYPE_LONGNAME, tarfile.XHDTYPE])
def test_endless_chain_of_tar_headers_is_rejected(kind: bytes) -> None:
    content = (
        b"a/0.jpg\0".ljust(512, b"\0")
        if kind == tarfile.GNUTYPE_LONGNAME
        else b"16 path=a/0.jpg\n".ljust(512, b"\0")
    )
    size = 8 if kind == tarfile.GNUTYPE_LONGNAME else 16
    read((header(kind, size) + content) * 20_000 + header(tarfile.REGTYPE, 0) + bytes(1024))


def test_long_pax_header_is_read_in_time() -> None:
    content = b"1" * 900_000
    read(
        header(tarfile.XHDTYPE, len(content))
        + content.ljust(-(-len(content) // 512) * 512, b"\0")
        + header(tarfile.REGTYPE, 0)
        + bytes(1024)
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("shards")


def usable(facts: dict[str, Any]) -> None:
    """What embedding, training and calibrating take from a sample's facts can be written down."""
    tag = facts["geotag"] or {}
    pa.array([facts["key"]], pa.string()), pa.array([facts["location"]], pa.string())
    assert View(facts["view"])
    assert Split(facts["split"])
    for lat, lon in [(tag["lat"], tag["lon"])] if tag else []:
        pa.array([lat, lon], pa.float64())
        assert abs(lat) <= 90
        assert abs(lon) <= 180


@given(
    st.data(),
    st.one_of(
        twisted(FACTS),
        values,
        twisted({"location": "a", "lat": 1.0, "lon": 2, "geotag": {"lat": 1}}),
    ),
)
@examples(150)
def test_sample_json_is_read_or_rejected(folder: Path, data: st.DataObject, metadata: Any) -> None:
    content = json.dumps(metadata).encode()
    content = data.draw(damaged(content)) if data.draw(st.booleans()) else content
    label = data.draw(st.binary(max_size=9))
    name = data.draw(st.sampled_from(["0", "a/0", "\udcff/0", "é"]))
    (folder / "query-drone-000000.tar").write_bytes(
        packed(
            [
                member(f"{name}.jpg", b"x"),
                member(f"{name}.json", content),
                member(f"{name}.cls", label),
            ],
            tarfile.GNU_FORMAT,
        )
    )
    tar = str(folder / "query-drone-000000.tar")
    for external in ((Split.QUERY, View.DRONE), None):
        with bounded(InputError):
            for sample in read_samples(tar, external):
                usable(sample.metadata)
                pa.array([sample.key], pa.string())
    with bounded(InputError):
        for location in read_locations(tar):
            assert isinstance(location, str)
    with bounded(InputError):
        assert check_shard(
            str(folder),
            Shard(
                name="query-drone-000000",
                split=Split.QUERY,
                view=View.DRONE,
                samples=1,
                bytes=1,
                sha256="",
            ),
        )
    with bounded(InputError):
        open_or_scan(str(folder), Split.QUERY, View.DRONE)
