"""The command line of all jobs: quick help, settings as a file, one command."""

import json
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import yaml

import jobs.locate
import jobs.make_shards
import jobs.train
from jobs.command_line import pvda
from jobs.command_line.cli import parse, run
from jobs.command_line.config import flatten_settings, to_yaml
from jobs.stages.settings import BuildIndexSettings, LocateSettings
from jobs.training.settings import RECIPE, RUN_CONFIG_FILE
from pipeline.core.errors import InputError
from pipeline.sources.photos import Photos

ROOT = Path(__file__).parents[2]
HEAVY = (
    "torch", "ray", "pyarrow", "faiss", "rasterio", "pandas", "matplotlib", "scipy", "aiohttp",
    "transformers",
)  # fmt: skip
HELP_OF_ALL = f"""
import contextlib, io, json, runpy, sys
found = {{}}
for name in {sorted(pvda.jobs())}:
    for words in (["--help"], ["--no-such-flag"]):
        sys.argv = [name, *words]
        code = None
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            try:
                runpy.run_module(f"jobs.{{name}}", run_name="__main__")
            except SystemExit as ended:
                code = ended.code
        found[f"{{name}} {{words[0]}}"] = [code, [m for m in {HEAVY} if m in sys.modules]]
print(json.dumps(found))
"""


@pytest.mark.slow
def test_help_and_refused_flags_import_nothing_heavy() -> None:
    command = [sys.executable, "-c", HELP_OF_ALL]
    ended = subprocess.run(command, capture_output=True, cwd=ROOT, check=True, text=True)
    found = json.loads(ended.stdout)
    assert len(found) == 2 * len(pvda.jobs())
    for call, (code, heavy) in found.items():
        assert code == (0 if call.endswith("--help") else 2), call
        assert heavy == [], call


def test_help_shows_flags_that_change_a_finished_output(
    capsys: pytest.CaptureFixture[str],
) -> None:
    for job, flags in (
        ("make_shards", ["--source", "--verify", "--export", "--extend"]),
        ("build_index", ["--extend", "--remove", "--verify"]),
        ("train", ["--like"]),
    ):
        script = import_module(f"jobs.{job}")
        choice = getattr(script, "SOURCE", getattr(script, "RECIPE", None))
        words = ["smoke", "--help"] if job == "train" else ["--help"]
        with pytest.raises(SystemExit):
            parse(script.main, words, choice, RUN_CONFIG_FILE if job == "train" else None)
        shown = capsys.readouterr().out
        for flag in [*flags, "--config", "--print-config"]:
            assert flag in shown, (job, flag)


def train_arguments(*words: str) -> dict[str, Any] | None:
    return parse(jobs.train.main, words, RECIPE, RUN_CONFIG_FILE)


def test_weights_of_the_hub_are_no_path() -> None:
    for given, expected in (("hf:owner/name", "hf:owner/name"), ("w.pt", str(Path.cwd() / "w.pt"))):
        arguments = train_arguments("smoke", "--shards", "s", "--out", "o", "--weights", given)
        assert arguments is not None
        assert arguments["settings"].run.weights == expected


def test_print_config_is_read_back_by_config(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["smoke", "--shards", "s", "--out", "o", "--epochs", "3", "--pad", "2", "--compile"]
    assert train_arguments(*words, "--print-config") is None
    path = tmp_path / "run.yaml"
    path.write_text(capsys.readouterr().out)
    assert train_arguments("--config", str(path)) == train_arguments(*words)
    other = train_arguments("--config", str(path), "--epochs", "5", "--no-compile")
    assert other == train_arguments(*words, "--epochs", "5", "--no-compile")
    paper = train_arguments("paper", "--config", str(path))
    assert paper is not None
    assert paper["settings"].recipe.schedule.epochs == 3


def test_config_holds_positionals_circles_and_a_source(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "job.yaml"
    words = ["a.jpg", "b c.jpg", "--checkpoint", "c", "--index", "i", "--out", "o"]
    words += ["--near", "1.5", "-2", "30"]
    assert parse(jobs.locate.main, [*words, "--print-config"]) is None
    path.write_text(capsys.readouterr().out)
    assert parse(jobs.locate.main, ["--config", str(path)]) == parse(jobs.locate.main, words)
    script = jobs.make_shards
    words = ["--source", "photos", "--root", "r", "--out", "o", "--view", "satellite"]
    assert parse(script.main, [*words, "--print-config"], script.SOURCE) is None
    path.write_text(capsys.readouterr().out)
    found = parse(script.main, ["--config", str(path)], script.SOURCE)
    assert found == parse(script.main, words, script.SOURCE)
    assert found is not None
    assert isinstance(found["source"], Photos)


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (None, "cannot be read as settings"),
        ("[1, 2]", "has no entries with names"),
        ("a: [", "cannot be read as settings"),
        ("recipe: papr", "unknown recipe 'papr', expected one of: paper"),
    ],
)
def test_config_that_is_no_settings_is_refused(
    tmp_path: Path, content: str | None, sentence: str
) -> None:
    path = tmp_path / "run.yaml"
    if content is not None:
        path.write_text(content)
    with pytest.raises(InputError, match=sentence):
        train_arguments("--config", str(path), "--shards", "s", "--out", "o")


def test_like_repeats_a_runs_settings_but_its_folder(tmp_path: Path) -> None:
    arguments = train_arguments("smoke", "--shards", "s", "--out", "o", "--seed", "7")
    assert arguments is not None
    entries = flatten_settings(arguments["settings"], RECIPE)
    del entries["out"]
    (tmp_path / RUN_CONFIG_FILE).write_text(to_yaml(entries))
    again = train_arguments("--like", str(tmp_path), "--out", "o")
    assert again == arguments
    with pytest.raises(InputError, match="found --config and --like"):
        train_arguments("--like", str(tmp_path), "--config", "x", "--out", "o")


def test_settings_of_build_index_need_a_table_to_build() -> None:
    assert BuildIndexSettings(out="i", verify=True).table == ""
    assert BuildIndexSettings(out="i", remove=("a",)).table == ""
    with pytest.raises(InputError, match="--table is '', expected a folder of features"):
        BuildIndexSettings(out="i")
    with pytest.raises(InputError, match="--table is ''"):
        BuildIndexSettings(out="i", extend=True)
    with pytest.raises(InputError, match="found --extend and --remove"):
        BuildIndexSettings(out="i", table="t", extend=True, remove=("a",))


def test_flatten_names_values_as_yaml_has_them() -> None:
    settings = LocateSettings(photos=("a",), checkpoint="c", index="i", out="o")
    entries = yaml.safe_load(to_yaml(flatten_settings(settings)))
    assert entries["photos"] == ["a"]
    assert entries["near"] is None
    assert entries["max-speed"] == 25.0


def test_pvda_lists_every_job_and_refuses_others(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["pvda", "--help"])
    with pytest.raises(SystemExit) as ended:
        pvda.main()
    shown = capsys.readouterr().out
    assert ended.value.code == 0
    scripts = {path.stem for path in (ROOT / "jobs").glob("[a-z]*.py")}
    assert {line.split()[0] for line in shown.splitlines()[2:]} == scripts
    assert all(len(line.split()) > 3 for line in shown.splitlines()[2:])
    monkeypatch.setattr(sys, "argv", ["pvda", "trian"])
    with pytest.raises(SystemExit) as ended:
        pvda.main()
    assert ended.value.code == 2
    assert (
        "unknown job 'trian', expected one of: adapt, benchmark, build_index,"
        in capsys.readouterr().err
    )


def test_pvda_runs_a_job(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(sys.modules, "jobs.train")  # a fresh process has not imported it
    monkeypatch.setattr(sys, "argv", ["pvda", "train", "smoke", "--help"])
    with pytest.raises(SystemExit) as ended:
        pvda.main()
    assert ended.value.code == 0
    assert "pvda train smoke" in capsys.readouterr().out


def test_a_closed_pipe_ends_a_job_in_silence() -> None:
    script = (
        "import sys\n"
        "from jobs.command_line.cli import run\n"
        "def main() -> None:\n    print('x' * 100_000)\n    print('y')\n"
        "sys.argv = ['job']\nrun(main)"
    )
    command = f'{sys.executable} -c "$SCRIPT" | head -c 1'
    ended = subprocess.run(
        ["bash", "-c", f"set -o pipefail; {command}"],
        capture_output=True, cwd=ROOT, check=False, text=True,
        env={"SCRIPT": script, "PATH": "/usr/bin:/bin"},
    )  # fmt: skip
    assert (ended.stdout, ended.stderr) == ("x", "")
    assert ended.returncode == 141


def test_run_prints_an_input_error_and_exits_2(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def main(out: str) -> None:
        raise InputError(f"{out} is wrong")

    monkeypatch.setattr(sys, "argv", ["job", "--out", "x\ny"])
    with pytest.raises(SystemExit) as ended:
        run(main)
    assert ended.value.code == 2
    assert "error: x\\ny is wrong" in capsys.readouterr().err
