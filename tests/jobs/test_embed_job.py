"""What the job embed_gallery does before and around the stage."""

from pathlib import Path

import pytest

from jobs.embed_gallery import main
from jobs.stages.settings import EmbedSettings
from pipeline.core.errors import InputError
from pipeline.core.records import Split, View
from pipeline.features import embed
from pipeline.shards.shard_set import ShardSet
from tests.model.lpn_twin import imported, made_up, three_view_net
from tests.shards.test_external import picture
from tests.shards.test_external_layouts import label, tar_file


def settings_of(folder: Path, checkpoint: Path) -> EmbedSettings:
    return EmbedSettings(
        shards=str(folder),
        checkpoint=str(checkpoint),
        out=str(folder.with_name("table")),
        split=Split.GALLERY,
        view=View.SATELLITE,
    )


def test_shards_of_others_are_scanned_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    imported(tmp_path, three_view_net(made_up()))
    tar_file(tmp_path / "shards" / "0.tar", {"a.jpg": picture(1), "a.json": label("x")})
    passed: list[object] = []
    monkeypatch.setattr(embed, "embed_gallery", lambda *given: passed.extend(given))
    main(settings_of(tmp_path / "shards", tmp_path / "ours.pt"))
    assert capsys.readouterr().err.count("reading 1 tars as shards that others made") == 1
    [_, _, shards] = passed
    assert isinstance(shards, ShardSet)
    assert [shard.samples for shard in shards.manifest.shards] == [1]


def test_unusable_checkpoint_is_refused_before_the_scan(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tar_file(tmp_path / "shards" / "0.tar", {"a.jpg": picture(1), "a.json": label("x")})
    (tmp_path / "ours.pt").write_bytes(b"no checkpoint")
    with pytest.raises(ValueError, match=r"ours\.pt"):
        main(settings_of(tmp_path / "shards", tmp_path / "ours.pt"))
    with pytest.raises(InputError, match=r"no checkpoint at .*none\.pt"):
        main(settings_of(tmp_path / "shards", tmp_path / "none.pt"))
    assert "reading" not in capsys.readouterr().err
