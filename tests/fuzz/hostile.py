"""Strategies that damage valid input: bytes, JSON values, names, numbers as text."""

import struct
from typing import Any

from hypothesis import strategies as st

WORDS = [0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0x8000, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF]
"Numbers at which lengths and offsets turn into something else."
NAMES = [
    "",
    ".",
    "..",
    "../../escaped",
    "/etc/passwd",
    "a/b",
    "a\\b",
    "C:\\x",
    "a\nb",
    "a\rb",
    "\x1b[2J",
    "\x00",
    "a\x07b",
    "[bold]",
    "[/]",
    "[link=file:///etc/passwd]x[/link]",
    "{0}",
    "%s",
    "~",
    "~root",
    "*",
    "?",
    "[a-z]",
    "a::b",
    "http://x/y",
    "file:x",
    "memory://x",
    "-rf",
    "--help",
    "'",
    '"',
    "`id`",
    "$(id)",
    ";id",
    "\ud800",
    "\udcff",
    "\ufeff",
    "\u202eabc",
    "é" * 200,
    "x" * 5000,
]
"""That mean something to a shell, a terminal, a file system, a template, an encoding, fsspec or
rich."""
TEXTS = [
    "nan",
    "inf",
    "-inf",
    "1e999",
    "-1e999",
    "-1",
    "0",
    "91",
    "-91",
    "181",
    "1,5",
    "1e5",
    "0x10",
    "١٢",
    "²",
    "1_000",
    " 1 ",
    "+1",
    "9" * 400,
    "1" * 3_000 + "x",
    "NaN",
    "None",
    "null",
    "true",
    "<script>",
    "=1+1",
    "\x00",
    "\ufffe",
    *NAMES,
]
"Cells of a table."
DEEP: Any = []
for _ in range(400):
    DEEP = [DEEP]
VALUES: list[Any] = [
    None,
    True,
    False,
    0,
    1,
    -1,
    2**31,
    2**63,
    2**64,
    10**30,
    0.5,
    -0.5,
    1e308,
    float("nan"),
    float("inf"),
    float("-inf"),
    [],
    {},
    [[]],
    {"": None},
    [None],
    {"a": 1},
    DEEP,
    "1",
    *NAMES,
]
"JSON values to put in another's position."

numbers = st.sampled_from(TEXTS) | st.floats().map(str) | st.integers().map(str)
names = st.sampled_from(NAMES) | st.text(max_size=12)
values = st.sampled_from(VALUES) | st.floats() | st.integers() | st.text(max_size=8)


@st.composite
def damaged(draw: st.DrawFn, data: bytes, most: int = 6, head: int = 0) -> bytes:
    """Bytes with a few edits; with `head`, mostly within the first so many."""
    found = bytearray(data)
    for _ in range(draw(st.integers(1, most))):
        end = min(len(found), head) if head and draw(st.booleans()) else len(found)
        at = draw(st.integers(0, max(0, end - 1)))
        kind = draw(st.integers(0, 7))
        if kind == 0 and found:
            found[at] ^= 1 << draw(st.integers(0, 7))
        elif kind == 1:
            word, form = (
                draw(st.sampled_from(WORDS)),
                draw(st.sampled_from(["<H", ">H", "<I", ">I", "<Q", ">Q"])),
            )
            packed = struct.pack(form, word & (1 << 8 * struct.calcsize(form)) - 1)
            found[at : at + len(packed)] = packed
        elif kind == 2:
            del found[at : at + draw(st.integers(1, 64))]
        elif kind == 3:
            found[at:at] = draw(st.binary(min_size=1, max_size=32))
        elif kind == 4:
            del found[at:]
        elif kind == 5:
            piece = found[at : at + draw(st.integers(1, 512))]
            found[at:at] = piece
        elif kind == 6:
            count = draw(st.integers(1, 64))
            found[at : at + count] = bytes([draw(st.sampled_from([0, 0x20, 0xFF]))]) * count
        else:
            found[at : at + 1] = draw(st.binary(min_size=1, max_size=4))
    return bytes(found)


@st.composite
def twisted(draw: st.DrawFn, value: Any, most: int = 3) -> Any:
    """A JSON value with one to `most` nodes replaced, removed, duplicated or renamed."""
    for _ in range(draw(st.integers(1, most))):
        value = _twist(draw, value)
    return value


def _twist(draw: st.DrawFn, value: Any) -> Any:
    if isinstance(value, dict) and value and draw(st.integers(0, 7)):
        name = draw(st.sampled_from(sorted(value)))
        rest = {key: kept for key, kept in value.items() if key != name}
        kind = draw(st.integers(0, 9))
        if kind == 0:
            return rest
        if kind == 1:
            return rest | {draw(names): value[name]}
        return value | {name: _twist(draw, value[name])}
    if isinstance(value, list | tuple) and value and draw(st.integers(0, 7)):
        at = draw(st.integers(0, len(value) - 1))
        kind = draw(st.integers(0, 9))
        if kind == 0:
            return [*value[:at], *value[at + 1 :]]
        if kind == 1:
            return [*value, value[at]]
        return [*value[:at], _twist(draw, value[at]), *value[at + 1 :]]
    return draw(values)
