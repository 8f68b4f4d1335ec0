"""Features to the field's .mat file and back, the challenge's answer file, and invalid files."""

import io
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io

from jobs.stages.import_features import import_and_print, judge_stated
from pipeline.core.errors import InputError
from pipeline.core.records import Split, View
from pipeline.evaluation import exports
from pipeline.evaluation.evaluate import evaluate
from pipeline.evaluation.settings import EvaluationSettings
from pipeline.features import mat_file
from pipeline.features.import_mat import import_features
from pipeline.features.part import PartFooter, PartRows, write_part
from pipeline.features.settings import ImportSettings
from pipeline.features.table import open_table
from tests.evaluation.test_evaluate import TEST_SET, made_table

pytestmark = pytest.mark.slow

FIGURES = ("queries", "gallery", "r1", "r5", "r10", "r1p", "ap")


@pytest.fixture
def read_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """The reader's code runs in this process: a new one takes a second to start."""

    def run(command: list[str], **options: Any) -> subprocess.CompletedProcess[bytes]:
        out, error = io.BytesIO(), io.BytesIO()
        with monkeypatch.context() as patch:
            for name, stream in (
                ("stdin", io.BytesIO(options["input"])),
                ("stdout", out),
                ("stderr", error),
            ):
                patch.setattr(sys, name, io.TextIOWrapper(stream, write_through=True))
            code = mat_file.main()
            for name in ("stdin", "stdout", "stderr"):
                getattr(sys, name).detach()
        return subprocess.CompletedProcess(command, code, out.getvalue(), error.getvalue())

    monkeypatch.setattr(subprocess, "run", run)


def saved(path: Path, **changed: Any) -> str:
    """A file as the public test scripts save it: five images of two locations."""
    rng = np.random.default_rng(5)
    content: dict[str, Any] = {
        "gallery_f": rng.standard_normal((3, 4)).astype(np.float32), "gallery_label": [839, 840, 7],
        "gallery_path": [f"/d/gallery_satellite/{n:04d}/{n:04d}.jpg" for n in (839, 840, 7)],
        "query_f": 9 * rng.standard_normal((2, 4)).astype(np.float32), "query_label": [839, 7],
        "query_path": ["/d/query_drone/0839/image-01.jpeg", "/d/query_drone/0007/image-1.jpeg"],
    }  # fmt: skip
    content |= changed
    scipy.io.savemat(
        str(path), {name: value for name, value in content.items() if value is not None}
    )
    return str(path)


@pytest.mark.slow
def test_import_mat_round_trip_keeps_measures(tmp_path: Path) -> None:
    queries, gallery = (
        made_table(tmp_path / "q", TEST_SET[:1]),
        made_table(tmp_path / "g", TEST_SET[3:]),
    )
    [ours] = evaluate(
        EvaluationSettings(
            queries=queries, gallery=gallery, out=str(tmp_path / "a"), exports=("mat", "answer")
        )
    )
    mat = str(tmp_path / "a" / "pytorch_result.mat")
    said = scipy.io.loadmat(mat)
    assert said["query_f"].shape == (10, 16)
    assert said["query_label"].shape == (1, 10)
    written = import_features(ImportSettings(mat=mat, out=str(tmp_path / "i")))
    assert {name: rows for name, (_, rows) in written.items()} == {"query": 10, "gallery": 16}
    back = open_table(str(tmp_path / "i" / "gallery"))
    assert back.labels().locations.tolist() == open_table(gallery).labels().locations.tolist()
    assert (
        back.labels().keys.tolist() == open_table(gallery).labels().keys.tolist()
    )  # so that the two can be compared
    assert back.embeddings() == pytest.approx(open_table(gallery).embeddings(), abs=1e-6)
    [theirs] = evaluate(
        EvaluationSettings(
            queries=str(tmp_path / "i" / "queries"),
            gallery=str(tmp_path / "i" / "gallery"),
            out=str(tmp_path / "b"),
        )
    )
    assert [theirs[name] for name in FIGURES] == [ours[name] for name in FIGURES]
    lines = (tmp_path / "a" / "answer.txt").read_text().splitlines()
    assert [len(line.split("\t")) for line in lines] == [10] * 10


@pytest.mark.usefixtures("read_here")
@pytest.mark.parametrize(
    ("stated", "judgement"),
    [
        ((95.82, 97.77), "impossible; with one true match a query, AP lies from 95.82 to 96.86"),
        ((82.73, 85.19), "possible; with one true match a query, AP lies from 82.73 to 87.05"),
        ((92.21, 90.39), "impossible"),
    ],
)
def test_import_mat_judges_stated_figures(
    tmp_path: Path, stated: tuple[float, float], judgement: str, capsys: pytest.CaptureFixture[str]
) -> None:
    mat = saved(tmp_path / "r.mat")
    import_and_print(ImportSettings(mat=mat, out=str(tmp_path / "out"), stated=stated))
    printed = " ".join(capsys.readouterr().err.split())
    assert f"stated R@1 {stated[0]:.2f} and AP {stated[1]:.2f}: {judgement}" in printed


@pytest.mark.usefixtures("read_here")
def test_import_mat_judges_nothing_of_several_matches(tmp_path: Path) -> None:
    written = import_features(
        ImportSettings(
            mat=saved(tmp_path / "r.mat", gallery_label=[839, 839, 7], gallery_path=None),
            out=str(tmp_path / "out"),
        )
    )
    sentence = judge_stated((95.82, 97.77), written["query"][0], written["gallery"][0])
    assert "not judged, since queries have up to 2 true matches" in sentence


@pytest.mark.usefixtures("read_here")
def test_import_mat_locations_from_paths_or_labels(tmp_path: Path) -> None:
    import_features(ImportSettings(mat=saved(tmp_path / "p.mat"), out=str(tmp_path / "p")))
    table = open_table(str(tmp_path / "p" / "gallery"))
    assert table.labels().locations.tolist() == ["0839", "0840", "0007"]
    assert table.labels().keys.tolist()[0] == "gallery-satellite-0839-0839"
    assert np.linalg.norm(table.embeddings(), axis=1) == pytest.approx(1)
    import_features(
        ImportSettings(mat=saved(tmp_path / "n.mat", query_path=None), out=str(tmp_path / "n"))
    )
    assert open_table(str(tmp_path / "n" / "queries")).labels().locations.tolist() == ["839", "7"]
    assert open_table(str(tmp_path / "n" / "gallery")).labels().locations.tolist() == [
        "839",
        "840",
        "7",
    ]


@pytest.mark.usefixtures("read_here")
@pytest.mark.parametrize("cells", [False, True])
def test_import_mat_takes_text_labels_as_names(tmp_path: Path, cells: bool) -> None:
    """Names of unlike length, as a matrix of padded characters or as cells."""
    kind = object if cells else np.str_
    labels = {
        "query_label": np.array(["tower", "07"], kind),
        "gallery_label": np.array(["tower", "-1", "07"], kind),
    }
    mat = saved(tmp_path / "t.mat", **labels, query_path=None, gallery_path=None)
    import_features(ImportSettings(mat=mat, out=str(tmp_path / "t")))
    for name in ("queries", "gallery"):
        table = open_table(str(tmp_path / "t" / name))
        assert table.labels().locations.tolist() == ["tower", "07"]


@pytest.mark.usefixtures("read_here")
def test_import_mat_takes_whole_floats_as_numbers(tmp_path: Path) -> None:
    mat = saved(tmp_path / "f.mat", query_label=[839.0, 7.0], query_path=None)
    import_features(ImportSettings(mat=mat, out=str(tmp_path / "f")))
    assert open_table(str(tmp_path / "f" / "queries")).labels().locations.tolist() == ["839", "7"]


@pytest.mark.usefixtures("read_here")
def test_import_mat_views_from_paths(tmp_path: Path) -> None:
    turned = {
        "query_path": ["/d/query_satellite/0839/a.jpg", "/d/query_satellite/0007/b.jpg"],
        "gallery_path": [f"/d/gallery_drone/{n:04d}/i.jpg" for n in (839, 840, 7)],
    }
    import_features(
        ImportSettings(mat=saved(tmp_path / "t.mat", **turned), out=str(tmp_path / "t"))
    )
    assert open_table(str(tmp_path / "t" / "queries")).counts == {(Split.QUERY, View.SATELLITE): 2}
    assert open_table(str(tmp_path / "t" / "gallery")).counts == {(Split.GALLERY, View.DRONE): 3}


@pytest.mark.usefixtures("read_here")
def test_import_mat_drops_junk_as_official_code(tmp_path: Path) -> None:
    mat = saved(tmp_path / "j.mat", gallery_label=[839, -1, 7])
    assert import_features(ImportSettings(mat=mat, out=str(tmp_path / "j")))["gallery"][1] == 2


@pytest.mark.usefixtures("read_here")
@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"query_f": None}, r"expected query_f too"),
        ({"query_label": [1, 2, 3]}, r"3 labels and 2 paths; expected one row"),
        ({"query_f": np.ones((2, 5))}, r"queries of 5 and a gallery of 4 dimensions"),
        ({"gallery_f": np.zeros((3, 4))}, r"row 0 of gallery_f .* has length 0"),
        ({"query_label": [0.5, 7]}, r"query_label that are no whole numbers \(row 0 is 0.5\)"),
        (
            {"gallery_label": [1, np.nan, 7]},
            r"no whole numbers \(row 1 is nan\); expected one whole",
        ),
        ({"query_label": ["0839", ""]}, r"empty in places \(row 1 is ''\); expected one whole"),
        (
            {"query_label": ["0839", "0007"]},
            r"query_label that are text and gallery_label that are",
        ),
        (
            {"query_label": np.array([{}, 7], object)},
            r"query_label has cells of .*not whole numbers",
        ),
    ],
)
def test_import_mat_rejects_mismatched_shapes(
    tmp_path: Path, changed: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(InputError, match=sentence):
        import_features(
            ImportSettings(mat=saved(tmp_path / "x.mat", **changed), out=str(tmp_path / "x"))
        )


def test_import_mat_rejects_other_files(tmp_path: Path) -> None:
    (tmp_path / "x.mat").write_text("nothing of the kind")
    for name, sentence in (
        ("x.mat", r"cannot be read as a .mat file"),
        ("y.mat", r"no file at .*check the path"),
    ):
        with pytest.raises(InputError, match=sentence):
            import_features(ImportSettings(mat=str(tmp_path / name), out=str(tmp_path / "o")))


def test_import_mat_rejects_folder_of_other_features(tmp_path: Path) -> None:
    made_table(tmp_path / "o" / "gallery", TEST_SET[2:3])
    with pytest.raises(InputError, match=r"not of these features; choose another --out"):
        import_features(ImportSettings(mat=saved(tmp_path / "p.mat"), out=str(tmp_path / "o")))


def test_mat_export_numbers_textual_locations(tmp_path: Path) -> None:
    for split, view in ((Split.QUERY, View.DRONE), (Split.GALLERY, View.SATELLITE)):
        write_part(
            str(tmp_path / "t" / f"{split}.parquet"),
            PartRows(
                keys=[f"{split}-a", f"{split}-b"],
                locations=["tower", "07"],
                views=[view] * 2,
                splits=[split] * 2,
                lats=[None] * 2,
                lons=[None] * 2,
                embeddings_BD=np.eye(2, dtype=np.float32),
            ),
            PartFooter(fingerprint="f", shard_sha256=split, rows=2),
        )
    table = open_table(str(tmp_path / "t"))
    (tmp_path / "t.mat").write_bytes(exports.mat_bytes(table, table, View.DRONE, View.SATELLITE))
    assert scipy.io.loadmat(str(tmp_path / "t.mat"))["query_label"].tolist() == [[1, 0]]
    import_features(ImportSettings(mat=str(tmp_path / "t.mat"), out=str(tmp_path / "i")))
    assert open_table(str(tmp_path / "i" / "queries")).labels().locations.tolist() == [
        "tower",
        "07",
    ]


def row(query: str, *best: str) -> dict[str, Any]:
    return {
        "query": query,
        "top_keys": [f"k{place}" for place in best],
        "top_locations": list(best),
    }


def test_answer_export_has_tab_separated_gallery_ids() -> None:
    rows = [row("q1", "0001", "0002"), row("q2", "0002", "0001")]
    assert exports.answer_text(rows) == "0001\t0002\n0002\t0001\n"
    names = {"q1": "Ab.jpeg", "q2": "Cd.jpeg", "k0001": "Xy.jpg", "k0002": "Zz.jpg"}
    assert exports.answer_text(rows, names, ["Cd.jpeg", "Ab.jpeg"]) == "Zz\tXy\nXy\tZz\n"
    with pytest.raises(
        InputError, match=r"1 of 2 names in the order were not queried, the first is No.jpeg"
    ):
        exports.answer_text(rows, names, ["Cd.jpeg", "No.jpeg"])
    with pytest.raises(InputError, match=r"two queries come from files named Ab.jpeg"):
        exports.answer_text(rows, names | {"q2": "Ab.jpeg"}, ["Ab.jpeg"])
