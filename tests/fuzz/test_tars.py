"""Tars from anywhere: samples, or a sentence why there are none.

Nothing is unpacked, and no size is trusted.
"""

import io
import json
import tarfile
from functools import cache

from hypothesis import given
from hypothesis import strategies as st

from pipeline.core.errors import InputError
from pipeline.shards.tar_reader import read_members
from tests.fuzz.bounds import bounded, examples
from tests.fuzz.hostile import damaged, names

FACTS = {
    "key": "query-drone-0001-0",
    "location": "0001",
    "view": "drone",
    "split": "query",
    "variant": "",
    "source": "photos",
    "geotag": {
        "lat": 47.5,
        "lon": 8.5,
        "altitude_m": 100.0,
        "heading_deg": 1.0,
        "pitch_deg": -90.0,
        "footprint": [[1, 2], [3, 4]],
    },
    "taken_at": None,
    "sha256": "0" * 64,
    "width": 16,
    "height": 16,
}
KINDS = [
    tarfile.REGTYPE,
    tarfile.AREGTYPE,
    tarfile.LNKTYPE,
    tarfile.SYMTYPE,
    tarfile.CHRTYPE,
    tarfile.BLKTYPE,
    tarfile.DIRTYPE,
    tarfile.FIFOTYPE,
    tarfile.CONTTYPE,
    tarfile.GNUTYPE_SPARSE,
    b"Z",
]
PAX = [
    "size",
    "path",
    "linkpath",
    "mtime",
    "uid",
    "GNU.sparse.map",
    "GNU.sparse.major",
    "GNU.sparse.minor",
    "GNU.sparse.size",
    "GNU.sparse.realsize",
    "GNU.sparse.name",
    "GNU.sparse.offset",
    "GNU.sparse.numbytes",
    "GNU.sparse.numblocks",
    "hdrcharset",
    "comment",
]
NUMBERS = [
    "0",
    "1",
    "-1",
    "1.5",
    "nan",
    "9" * 30,
    "0,1000000000000",
    "0,1,",
    "a,b",
    "1" * 50,
    "",
    "1000000000000",
    "0,512",
]


def packed(members: list[tuple[tarfile.TarInfo, bytes]], form: int) -> bytes:
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w", format=form) as tar:
        for info, data in members:
            try:
                tar.addfile(info, io.BytesIO(data) if info.isreg() else None)
            except (ValueError, OverflowError, UnicodeError, OSError):
                continue
    return stream.getvalue()


def member(
    name: str, data: bytes, kind: bytes = tarfile.REGTYPE, pax: dict[str, str] | None = None
) -> tuple[tarfile.TarInfo, bytes]:
    info = tarfile.TarInfo(name)
    info.size, info.type, info.linkname, info.pax_headers = (
        len(data),
        kind,
        "/etc/passwd",
        pax or {},
    )
    return info, data


@cache
def plain(form: int = tarfile.PAX_FORMAT) -> bytes:
    long = "folder/" * 40
    content = json.dumps(FACTS).encode()
    return packed(
        [
            member("0.jpg", b"x" * 600),
            member("0.json", content),
            member(f"{long}1.png", b"y"),
            member(f"{long}1.cls", b"7"),
        ],
        form,
    )


def read(data: bytes) -> None:
    with bounded(InputError):
        for key, members in read_members(io.BytesIO(data), "it.tar", ("jpg", "json", "cls", "png")):
            assert isinstance(key, str)
            assert ".." not in key.split("/")
            assert sum(map(len, members.values())) <= len(data)


@given(st.data(), st.sampled_from([tarfile.USTAR_FORMAT, tarfile.GNU_FORMAT, tarfile.PAX_FORMAT]))
@examples(150)
def test_damaged_tar_is_read_or_rejected(data: st.DataObject, form: int) -> None:
    read(data.draw(damaged(plain(form), head=2048)))


@given(
    st.lists(
        st.tuples(
            names | st.just("0.jpg"),
            st.binary(max_size=600),
            st.sampled_from(KINDS),
            st.dictionaries(st.sampled_from(PAX), st.sampled_from(NUMBERS) | names, max_size=4),
        ),
        max_size=5,
    ),
    st.data(),
)
@examples(150)
def test_tar_members_of_any_name_and_type_are_bounded(
    members: list[tuple[str, bytes, bytes, dict[str, str]]], data: st.DataObject
) -> None:
    form = data.draw(
        st.sampled_from([tarfile.USTAR_FORMAT, tarfile.GNU_FORMAT, tarfile.PAX_FORMAT])
    )
    intact = packed(
        [
            member(f"{name}.jpg" if data.draw(st.booleans()) else name, body, kind, pax)
            for name, body, kind, pax in members
        ],
        form,
    )
    read(intact)
    read(data.draw(damaged(intact)))
