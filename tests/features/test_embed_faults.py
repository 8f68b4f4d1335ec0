"""After any fault the table ends up with the bytes of an undisturbed run, and no other files.

Where actors are no part of the matter, this process embeds, as in the undisturbed run.

Random kills, of workers and of the stage, are in the long campaign of tests/chaos (`make chaos`).
"""

import errno
import hashlib
import io
import os
import shutil
import signal
import tarfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pipeline.core import cluster, json_files, storage
from pipeline.core.cluster import Node
from pipeline.core.errors import Incomplete, InputError
from pipeline.features.embed import embed_gallery
from pipeline.features.embed_worker import Encoder, EncoderSpec
from pipeline.features.encoding import EncodingConfig
from pipeline.features.part import part_names, read_footer
from pipeline.features.rejected import read_rejected
from pipeline.features.settings import EmbeddingSettings
from pipeline.features.table import open_table, verify_table
from pipeline.shards.manifest import Shard, read_manifest
from tests.damaging import update_checksum

ENCODING = EncodingConfig(mirror=False, resizer="pillow", precision="float32")


def mean_colour_encoder(
    seconds: float = 0.0,
    pids: str = "",
    at_start: Callable[[], None] = lambda: None,
    fault: str = "",
) -> EncoderSpec:
    """An encoder that needs no weights: the mean colour's unit vector. It takes `seconds` a batch,
    and its worker writes its process id into the folder `pids`; `fault` names what happens to a
    black image."""

    def factory(threads: int) -> Encoder:
        at_start()
        if pids:
            (Path(pids) / str(os.getpid())).touch()

        def encode(images_B3HW: np.ndarray) -> np.ndarray:
            time.sleep(seconds)
            black_B = images_B3HW.max((1, 2, 3)) == 0
            if fault == "kill" and black_B.any():
                os.kill(os.getpid(), signal.SIGKILL)
            if fault == "raise" and black_B.any():
                raise ZeroDivisionError("a kernel failed")
            mean_B3 = images_B3HW.mean((2, 3)).astype(np.float32) + 1
            unit_B3: np.ndarray = mean_B3 / np.linalg.norm(mean_B3, axis=1, keepdims=True)
            if fault == "nan":
                unit_B3[black_B] = np.nan
            return unit_B3

        return encode

    return EncoderSpec(fingerprint="f" * 64, encoding=ENCODING, image_size=16, factory=factory)


def settings_of(shards: str | Path, out: str | Path, **more: Any) -> EmbeddingSettings:
    return EmbeddingSettings(
        shards=str(shards), out=str(out), **{"batch_size": 2, "workers": 0} | more
    )


def files_of(table: str | Path) -> dict[str, bytes]:
    """Every file of a table, hidden ones too."""
    files = (path for path in Path(table).rglob("*") if path.is_file())
    return {str(path.relative_to(table)): path.read_bytes() for path in files}


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory, tiny_shards: str) -> dict[str, bytes]:
    out = tmp_path_factory.mktemp("undisturbed")
    embed_gallery(settings_of(tiny_shards, out), mean_colour_encoder())
    return files_of(out)


def shard_of(shards: str | Path, number: int = 3) -> Shard:
    return read_manifest(str(shards)).shards[number]


@pytest.fixture
def copied(tmp_path: Path, tiny_shards: str) -> Path:
    """The shards, to be damaged."""
    return Path(shutil.copytree(tiny_shards, tmp_path / "shards"))


def blacken(shards: Path, shard: Shard) -> None:
    """Put a black image in a shard's first place, of the same size as the one that was there."""
    path = shards / f"{shard.name}.tar"
    with tarfile.open(path) as tar:
        member = next(one for one in tar.getmembers() if one.name.endswith(".jpg"))
    buffer = io.BytesIO()
    Image.new("RGB", (16, 16)).save(buffer, "JPEG")
    data = bytearray(path.read_bytes())
    room = data[member.offset_data : member.offset_data + member.size]
    assert len(buffer.getvalue()) <= len(room)
    black = buffer.getvalue().ljust(len(room), b"\0")
    data[member.offset_data : member.offset_data + member.size] = black
    before, after = (hashlib.sha256(image).hexdigest().encode() for image in (room, black))
    path.write_bytes(bytes(data).replace(before, after))
    update_checksum(shards, shard.name)


def test_embed_skips_shard_that_kills_its_worker(
    tmp_path: Path, copied: Path, undisturbed: dict[str, bytes], ray_cluster: None
) -> None:
    out, shard, pids = tmp_path / "table", shard_of(copied), tmp_path / "pids"
    pids.mkdir()
    blacken(copied, shard)
    with pytest.raises(
        Incomplete, match=rf"1 of \d+ shards .* again: {shard.name} \(lost 3 workers: "
    ):
        embed_gallery(
            settings_of(copied, out, workers=2), mean_colour_encoder(fault="kill", pids=str(pids))
        )
    # Two at first, and one for each death after which there was more to do.
    assert 3 <= len(list(pids.iterdir())) <= 5
    [listed] = read_rejected(str(out)).to_pylist()
    found = (listed["shard"], listed["key"], listed["reason"])
    assert found == (shard.name, None, "lost 3 workers")
    parts = {name: data for name, data in files_of(out).items() if name.endswith(".parquet")}
    kept = {name: data for name, data in parts.items() if "rejected" not in name}
    parts = {name: data for name, data in undisturbed.items() if name.endswith(".parquet")}
    assert kept == {name: data for name, data in parts.items() if name != f"{shard.name}.parquet"}
    assert len(open_table(str(out)).parts) == len(parts) - 1  # a skipped part is not expected
    # The encoder is repaired: only that shard is embedded, and the list goes with its last entry.
    assert embed_gallery(settings_of(copied, out), mean_colour_encoder()) == shard.samples
    assert files_of(out).keys() == undisturbed.keys()


def test_embed_unexpected_error_skips_one_shard(
    tmp_path: Path, copied: Path, ray_cluster: None
) -> None:
    shard = shard_of(copied)
    blacken(copied, shard)
    out, raising = tmp_path / "table", mean_colour_encoder(fault="raise")
    said = rf"{shard.name} \(lost 3 workers: ZeroDivisionError: a kernel failed\)"
    with pytest.raises(Incomplete, match=said):
        embed_gallery(settings_of(copied, out, workers=1), raising)
    assert len(part_names(str(out))) == len(read_manifest(str(copied)).shards) - 1


def test_embed_rejects_nan_embeddings(tmp_path: Path, copied: Path) -> None:
    shard = shard_of(copied)
    blacken(copied, shard)
    with pytest.raises(
        Incomplete,
        match=rf"the network gives {shard.split}-{shard.view}-\S+ an embedding of length nan",
    ):
        embed_gallery(settings_of(copied, tmp_path / "table"), mean_colour_encoder(fault="nan"))
    verify_table(str(tmp_path / "table"))


def test_embed_skips_truncated_tar_until_repaired(
    tmp_path: Path,
    copied: Path,
    tiny_shards: str,
    undisturbed: dict[str, bytes],
    ray_cluster: None,
) -> None:
    out, shard, pids = tmp_path / "table", shard_of(copied), tmp_path / "pids"
    pids.mkdir()
    tar = copied / f"{shard.name}.tar"
    whole = tar.read_bytes()
    tar.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(
        Incomplete, match=rf"{shard.name} \(unusable: \S+{shard.name}\.tar has \d+ bytes"
    ):
        embed_gallery(settings_of(copied, out, workers=1), mean_colour_encoder(pids=str(pids)))
    assert len(list(pids.iterdir())) == 1  # no worker was lost over it
    assert [row["shard"] for row in read_rejected(str(out)).to_pylist()] == [shard.name]
    tar.write_bytes(whole)
    assert embed_gallery(settings_of(copied, out), mean_colour_encoder()) == shard.samples
    assert files_of(out) == undisturbed


def test_embed_shard_without_images_gives_empty_part(tmp_path: Path, copied: Path) -> None:
    manifest, out = read_manifest(str(copied)), str(tmp_path / "table")
    shard = min(manifest.shards, key=lambda one: one.samples)
    tar = copied / f"{shard.name}.tar"
    tar.write_bytes(tar.read_bytes().replace(b"\xff\xd8\xff", b"\0\0\0"))
    update_checksum(copied, shard.name)
    total = sum(one.samples for one in manifest.shards)
    assert embed_gallery(settings_of(copied, out), mean_colour_encoder()) == total
    footer = read_footer(storage.join(out, f"{shard.name}.parquet"))
    assert (footer.rows, len(footer.rejected)) == (0, shard.samples)
    assert open_table(out).embeddings().shape == (total - shard.samples, 3)
    assert len(read_rejected(out)) == shard.samples
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "table").rglob("*")}
    assert embed_gallery(settings_of(copied, out), mean_colour_encoder()) == 0
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "table").rglob("*")} == before


def full_disk() -> Callable[[], None]:
    """A function for a worker to call: after two files, the disk is full."""

    def fill() -> None:
        left, atomic_file = [2], storage.atomic_file

        @contextmanager
        def limited(path: str) -> Iterator[str]:
            with atomic_file(path) as local:
                yield local
                if left[0] <= 0:
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            left[0] -= 1  # the file is there, whatever the next one meets

        # By its name, for mypy accepts no other value for a module's function.
        setattr(storage, "atomic_file", limited)  # noqa: B010

    return fill


def test_embed_full_disk_stops_and_resumes(
    tmp_path: Path, tiny_shards: str, undisturbed: dict[str, bytes], ray_cluster: None
) -> None:
    out = tmp_path / "table"
    with pytest.raises(
        Incomplete, match=r"cannot be written \(No space left on device\).*to resume"
    ):
        embed_gallery(
            settings_of(tiny_shards, out, workers=1), mean_colour_encoder(at_start=full_disk())
        )
    assert 2 <= len(part_names(str(out))) < len(undisturbed)
    # A worker that was stopped with the stage may leave a hidden partial file.
    assert all(
        data == undisturbed[name]
        for name, data in files_of(out).items()
        if not name.startswith(".")
    )
    embed_gallery(settings_of(tiny_shards, out), mean_colour_encoder())
    assert files_of(out) == undisturbed


def test_embed_sweeps_leftovers_and_repairs_torn_part(
    tmp_path: Path, tiny_shards: str, undisturbed: dict[str, bytes]
) -> None:
    embed_gallery(settings_of(tiny_shards, tmp_path), mean_colour_encoder())
    first, second = [name for name in sorted(undisturbed) if name.endswith(".parquet")][:2]
    (tmp_path / f".{first}.0123abcd").write_bytes(b"half")
    (tmp_path / second).write_bytes(undisturbed[second][:100])
    embed_gallery(settings_of(tiny_shards, tmp_path), mean_colour_encoder())
    assert files_of(tmp_path) == undisturbed


def test_embed_more_workers_than_cpus_still_finishes(
    tmp_path: Path,
    tiny_shards: str,
    undisturbed: dict[str, bytes],
    monkeypatch: pytest.MonkeyPatch,
    ray_cluster: None,
) -> None:
    monkeypatch.setattr(cluster, "nodes", lambda: [Node(cpus=2.0)])
    embed_gallery(settings_of(tiny_shards, tmp_path, workers=3), mean_colour_encoder(seconds=0.01))
    assert files_of(tmp_path) == undisturbed


def test_embed_gives_up_without_room_for_a_worker(
    tmp_path: Path, tiny_shards: str, ray_cluster: None, capfd: pytest.CaptureFixture[str]
) -> None:
    settings = settings_of(tiny_shards, tmp_path, workers=2, cpus_per_worker=1000, patience=2.0)
    with pytest.raises(
        InputError,
        match=r"each asks for 1000 CPUs, and the largest of 1 nodes has \d+ CPUs; start nodes",
    ):
        embed_gallery(settings, mean_colour_encoder())


def test_embed_after_extension_embeds_new_shards_only(
    tmp_path: Path, copied: Path, undisturbed: dict[str, bytes]
) -> None:
    out, manifest = tmp_path / "table", copied / "manifest.json"
    content = json_files.read_checksummed(str(manifest))
    shards = content["shards"]
    json_files.write_checksummed(str(manifest), content | {"shards": shards[:-2]})
    embed_gallery(settings_of(copied, out), mean_colour_encoder())
    json_files.write_checksummed(str(manifest), content)
    assert embed_gallery(settings_of(copied, out), mean_colour_encoder()) == sum(
        one["samples"] for one in shards[-2:]
    )
    assert files_of(out) == undisturbed
    assert len(open_table(str(out)).labels().keys) == sum(one["samples"] for one in shards)
