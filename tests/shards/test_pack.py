"""Packing resumes, repairs, and reads and writes any storage."""

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import fsspec
import pytest

from jobs import make_shards
from jobs.command_line.cli import expand
from pipeline.core.errors import InputError
from pipeline.core.records import ImageRecord, Split, View
from pipeline.shards import pack_tars
from pipeline.shards.manifest import read_manifest
from pipeline.shards.pack import pack
from pipeline.shards.pack_tars import TooManyRejected
from pipeline.shards.plan import ShardPlan, ShardSize, plan_shards
from pipeline.shards.record_table import Packed, read_part
from pipeline.shards.writer import write_shard
from tests.shards.imagery import SOURCE, content, imagery, packing, rejected


def test_pack_tasks_and_one_process_write_the_same(tmp_path: Path, ray_cluster: None) -> None:
    root = imagery(tmp_path / "root")
    pack(SOURCE, packing(root, tmp_path / "alone"))
    pack(SOURCE, packing(root, tmp_path / "tasks", workers=2))
    assert content(tmp_path / "alone") == content(tmp_path / "tasks")


def test_pack_resumes_after_a_stop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root, out = imagery(tmp_path / "root"), tmp_path / "out"
    intact = pack(SOURCE, packing(root, tmp_path / "whole"))
    written: list[str] = []

    def stop_at_the_third(plan: ShardPlan, *given: Any) -> Packed:
        if len(written) == 2:
            raise KeyboardInterrupt
        written.append(plan.name)
        return write_shard(plan, *given)

    with monkeypatch.context() as patch:
        patch.setattr(pack_tars, "write_shard", stop_at_the_third)
        with pytest.raises(KeyboardInterrupt):
            pack(SOURCE, packing(root, out))
    with pytest.raises(InputError, match="not a finished set"):
        read_manifest(str(out))
    before = {name: (out / f"{name}.tar").stat().st_mtime_ns for name in written}
    assert pack(SOURCE, packing(root, out)) == intact
    assert {name: (out / f"{name}.tar").stat().st_mtime_ns for name in written} == before
    assert content(out) == content(tmp_path / "whole")


def test_pack_retries_a_repaired_image(tmp_path: Path) -> None:
    root, out = imagery(tmp_path / "root"), tmp_path / "out"
    bad = root / "train/drone/0001/image-02.jpeg"
    good = bad.read_bytes()
    bad.write_bytes(good[:100])
    with pytest.raises(
        TooManyRejected,
        match=r"1 of 15 images were refused, more than 1\.00%: (truncated|damaged) image",
    ):
        pack(SOURCE, packing(root, out))
    assert [name for name, _ in rejected(out)] == ["image-02.jpeg"]
    bad.write_bytes(good)
    pack(SOURCE, packing(root, out))
    assert rejected(out) == []
    pack(SOURCE, packing(root, tmp_path / "whole"))
    assert content(out) == content(tmp_path / "whole")


def test_pack_other_settings_remove_old_tars(tmp_path: Path) -> None:
    root, out = imagery(tmp_path / "root"), tmp_path / "out"
    (root / "train/drone/0001/bad.jpeg").write_bytes(b"no image")
    (out / "notes.tar").parent.mkdir()
    (out / "notes.tar").write_bytes(b"mine")
    with pytest.raises(TooManyRejected):
        pack(SOURCE, packing(root, out, samples_per_shard=1))
    pack(SOURCE, packing(root, out, samples_per_shard=100, max_bad_fraction=0.5))
    kept = sorted(path.name for path in out.glob("*.tar"))
    assert kept == [
        "notes.tar",
        "train-drone-000000.tar",
        "train-satellite-000000.tar",
    ]


def test_pack_repairs_a_lost_tar(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root, out = imagery(tmp_path / "root"), tmp_path / "out"
    pack(SOURCE, packing(root, out))
    before = content(out)
    (out / "train-drone-000001.tar").unlink()
    (out / "train-drone-000000.tar").write_bytes(b"short")
    pack(SOURCE, packing(root, out))
    assert "2 shards are missing or damaged" in capsys.readouterr().err.replace("\n", " ")
    assert content(out) == before


def test_pack_writes_to_any_storage(tmp_path: Path) -> None:
    root = imagery(tmp_path / "root")
    pack(SOURCE, packing(root, tmp_path / "disk"))
    memory = fsspec.filesystem("memory")
    pack(SOURCE, packing(root, "memory://packed/shards"))
    names = [name for name in content(tmp_path / "disk") if name.endswith(".tar")]
    assert {name: memory.cat_file(f"/packed/shards/{name}") for name in names} == {
        name: (tmp_path / "disk" / name).read_bytes() for name in names
    }


def test_pack_reads_from_any_storage(tmp_path: Path) -> None:
    root = imagery(tmp_path / "root")
    fsspec.filesystem("memory").put(str(root), "/imagery", recursive=True)
    assert (
        pack(SOURCE, packing(root, tmp_path / "a")).shards
        == pack(SOURCE, packing("memory://imagery", tmp_path / "b")).shards
    )


def test_pack_relative_root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    imagery(tmp_path / "root")
    monkeypatch.chdir(tmp_path)
    manifest = pack(SOURCE, packing("root", "out"))
    paths = read_part(str(tmp_path / "out"), manifest.shards[0].name, ["path"])["path"].to_pylist()
    assert all(path.startswith(f"{tmp_path}/root/") for path in paths)


def test_pack_rejects_a_name_that_is_not_utf8(tmp_path: Path) -> None:
    root = imagery(tmp_path / "root")
    os.link(
        root / "train/drone/0000/image-00.jpeg",
        os.fsencode(root) + b"/train/drone/0000/caf\xe9.jpeg",
    )
    pack(SOURCE, packing(root, tmp_path / "out", max_bad_fraction=0.1))
    assert rejected(tmp_path / "out") == [("caf\\udce9.jpeg", "name is not UTF-8")]


def test_plan_megabytes_per_shard() -> None:
    records = [
        ImageRecord(
            path=f"/{number}.jpg", split=Split.TRAIN, view=View.DRONE, location="a", bytes=400_000
        )
        for number in range(10)
    ]
    plans, _ = plan_shards(records, ShardSize(megabytes_per_shard=1.0))
    assert [len(plan.records) for plan in plans] == [2, 2, 2, 2, 2]
    plans, _ = plan_shards(
        [replace(record, bytes=3_000_000) for record in records[:2]],
        ShardSize(megabytes_per_shard=1.0),
    )
    assert [len(plan.records) for plan in plans] == [1, 1]


def test_a_source_is_named_by_a_flag_in_either_form() -> None:
    for words in (
        ["--root", "x", "--source", "xyz", "--zoom", "3"],
        ["--root", "x", "--source=xyz", "--zoom", "3"],
    ):
        found = expand(make_shards.main, words, make_shards.SOURCE, None)
        assert found == ("xyz", ["--root", "x", "--zoom", "3"])
    assert expand(make_shards.main, ["--help"], make_shards.SOURCE, None) == (None, ["--help"])
