"""JSON files with a checksum, and JSON validated into dataclasses: hostile values are refused by
the name of their field."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import pytest

from pipeline.core import storage
from pipeline.core.json_files import (
    checksum_of,
    from_json,
    read_checksummed,
    write_checksummed,
)
from pipeline.core.records import Rejection, View

CONTENT = {"b": 1.5, "a": [None, "é"], "n": {"2": 1, "10": 2}}


@dataclass(frozen=True, kw_only=True)
class Item:
    name: str
    view: View = View.DRONE
    pair: tuple[float, int] | None = None


@dataclass(frozen=True, kw_only=True)
class Report:
    items: tuple[Item, ...]
    count: int
    share: float
    done: bool
    kind: Literal["few", "many"]
    counts: dict[str, int]
    anything: Any = None


VALID: dict[str, Any] = {
    "items": [{"name": "a", "view": "satellite", "pair": [1, 2]}, {"name": "b"}],
    "count": 3, "share": 1, "done": True, "kind": "few", "counts": {"x": 1}, "anything": [None, {}],
}  # fmt: skip


def test_checksummed_json_comes_back(tmp_path: Path) -> None:
    path = str(tmp_path / "a.json")
    write_checksummed(path, CONTENT)
    assert read_checksummed(path) == CONTENT
    assert storage.read_json(path)["checksum"] == checksum_of(dict(reversed(CONTENT.items())))


def test_changed_json_is_refused(tmp_path: Path) -> None:
    path = str(tmp_path / "a.json")
    storage.write_json(path, CONTENT | {"b": 2, "checksum": checksum_of(CONTENT)})
    with pytest.raises(ValueError, match="does not match its checksum"):
        read_checksummed(path)


@pytest.mark.parametrize("key", [None, "seal", "chekcsum"])
def test_json_without_checksum_is_refused(tmp_path: Path, key: str | None) -> None:
    path = str(tmp_path / "a.json")
    storage.write_json(path, CONTENT | ({key: checksum_of(CONTENT)} if key else {}))
    with pytest.raises(ValueError, match="has no entry 'checksum'"):
        read_checksummed(path)


def test_json_of_another_kind_is_refused(tmp_path: Path) -> None:
    path = str(tmp_path / "a.json")
    storage.write_json(path, [1])
    with pytest.raises(ValueError, match="holds a list, expected an object"):
        read_checksummed(path)


def test_from_json_builds_the_dataclass() -> None:
    report = from_json(Report, VALID)
    first = Item(name="a", view=View.SATELLITE, pair=(1.0, 2))
    assert report.items == (first, Item(name="b"))
    assert isinstance(report.share, float)
    assert isinstance(report.items[1].view, View)
    assert report.anything == [None, {}]
    rejection = Rejection(path="a", reason="b", found="c" * 900)
    assert from_json(Rejection, asdict(rejection)) == rejection


@pytest.mark.parametrize(
    ("field", "value", "sentence"),
    [
        ("count", "3", "Report.count is '3', expected a valid integer"),
        ("count", True, "Report.count is True, expected a valid integer"),
        ("count", 3.0, "Report.count is 3.0, expected a valid integer"),
        ("count", None, "Report.count is None, expected a valid integer"),
        ("share", "1", "Report.share is '1', expected a valid number"),
        ("share", True, "Report.share is True, expected a valid number"),
        ("share", float("nan"), "Report.share is nan, expected a finite number"),
        ("share", float("-inf"), "Report.share is -inf, expected a finite number"),
        ("share", 10**400, "Report.share is 1000.*, expected a finite number"),
        ("done", 1, "Report.done is 1, expected a valid boolean"),
        ("kind", "some", "Report.kind is 'some', expected 'few' or 'many'"),
        ("counts", {"x": 1.5}, "Report.counts.x is 1.5, expected a valid integer"),
        ("counts", [1], r"Report.counts is \[1\], expected an object"),
        ("items", {}, r"Report.items is \{\}, expected a valid array"),
        ("items", [[]], r"Report.items\[0\] is \[\], expected an object"),
        ("items", [{"name": "a"}, {"name": 5}], r"Report.items\[1\].name is 5, expected a val"),
        ("items", [{"name": "a", "view": "moon"}], r"Report.items\[0\].view is 'moon', exp"),
        ("items", [{"name": "a", "pair": [1]}], r"Report.items\[0\].pair\S* "),
        ("items", [{"name": "a", "pair": [1, 2, 3]}], r"Report.items\[0\].pair\S* "),
        ("items", [{"view": "drone"}], r"Report.items\[0\] has no field 'name'"),
        ("items", [{"name": "a", "b": 1}], r"Report.items\[0\] has an unknown field 'b'"),
        ("items", [{"name": "\ud800"}], r"Report.items\[0\].name is not UTF-8 text"),
        ("counts", {"\ud800": 1}, "Report.counts is not UTF-8 text"),
        ("anything", {"a": ["\udcff"]}, r"Report.anything.a\[0\] is not UTF-8 text"),
    ],
)  # fmt: skip
def test_from_json_names_the_hostile_field(field: str, value: Any, sentence: str) -> None:
    with pytest.raises(ValueError, match=f"^{sentence}"):
        from_json(Report, VALID | {field: value})


def test_from_json_refuses_endless_nesting() -> None:
    deep: Any = []
    for _ in range(400):
        deep = [deep]
    with pytest.raises(ValueError, match="Report is nested too deeply"):
        from_json(Report, VALID | {"anything": deep})
    with pytest.raises(ValueError, match=r"Report is \[1\], expected an object"):
        from_json(Report, [1])


def test_from_json_cuts_long_values() -> None:
    with pytest.raises(ValueError, match="unknown field") as refused:
        from_json(Report, VALID | {"x" * 9_000: 1})
    assert len(str(refused.value)) < 400
