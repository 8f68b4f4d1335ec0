"""Every script of benchmarks/ runs at its smallest size and prints its ratio to a baseline."""

import json
import re
import sys
from pathlib import Path

import pytest
import ray

from tests.launcher import ROOT, Launcher

FOLDER = ROOT / "benchmarks"
HELPERS = {
    *("synthetic", "ablation_data", "embedding_worker", "gpu_measurements", "page_cache"),
    *("made_table", "whole_map"),
}
"Modules that other benchmarks import."
RESNET = "--backbone resnet18 --width 0.25 --size 128"
"The smallest network of the embedding benchmarks."
ONE_ROUND = f"{RESNET} --rounds 1"

CASES: dict[str, tuple[str, str]] = {
    "ablation": (
        "--textures {images} --out {out} --seeds 1 --period 1 --recipes paper --town-epochs 1 "
        "--scale 0.01",
        r"1 seeds: d2s_r1 \d",
    ),
    "big_map": (
        "--out {out} --side-px 2000 --resolution 0.1 --photos 1",
        r"locate \| 200 .* \| 1.00 x(.|\n)*locate \| 2,000 .* [\d.]+ x \|",
    ),
    "cold_table": (
        "--rows 400 --dimension 32 --parts 4 --queries 4 --candidates 3",
        r"\| cold, as an index reads \| [\d.]+ \| [\d.]+ \| [\d.]+ x \|",
    ),
    "damage": (
        "--rows 512 --depth 18 --repeats 1",
        r"a checkpoint loaded: [\d.]+ x the time without checks",
    ),
    "dense_features": (
        "--region {adapted}/region/tiles {adapted}/region/index "
        "{adapted}/region/flights/check/photos.csv {adapted}/map/surface.tif --photos 2 --steps 1 "
        "--out {out}/head.safetensors",
        r"nearest is right: [\d.]+% by random weights, [\d.]+% trained, [\d.]+ x",
    ),
    "embed": (
        f"{ONE_ROUND} --encoders folded openvino --probes 2 --calibration 2 --batch-size 2",
        r"openvino: [\d.]+ x the plain encoder's images per second",
    ),
    "embed_pipeline": (
        f"{ONE_ROUND} --distinct 4 --seconds 0.1 --few 0",
        r"tar -> Parquet.* [\d.]+ x the encoder alone",
    ),
    "embed_script": (
        f"{ONE_ROUND} --images 4 --batch 2 --precisions float32 --compiling never",
        r"[\d.]+ x the plain script .*cosine with it 1\.0000",
    ),
    "embeddings": (
        "--imagery {images} --checkpoint {trained}/run/last.pt --out {out} --rows 20 --queries 5 "
        "--batch-size 10",
        r"gallery: 20 of 20, \d+ crops/s, [\d.]+ x the encoder alone",
    ),
    "encoders": (
        "--shards {trained}/shards {trained}/run/last.pt builtin "
        "--precisions float32 float32:bfloat16",
        r"builtin, float32: R@1 .* [\d.]+ x the first encoder's",
    ),
    "evaluate": ("--scale 0.01", r"satellite->drone .* [\d.]+ x the float32 products"),
    "gpu": (
        "--out {out} --networks built-in --width 0.25 --size 128 --batch 2 --train-batch 2 "
        "--steps 1 --rounds 1 --seconds 0.01 --compiling never --minutes 4",
        r"training, built-in: [\d.]+ images/s, [\d.]+ x the resident loop's(.|\n)*"
        r"\| embedding, built-in, float32, folded.* \| 1\.0000",
    ),
    "index": (
        "--rows 2000 --dimension 32 --rounds 1 --cold 2 --factories planned former",
        r"Flat \(the planner\) .* [\d.]+ x \|(.|\n)*Flat \(the former rule\) ",
    ),
    "fixed_costs": (
        "--out {out} --rounds 1 --jobs simulate",
        r"\| simulate \| [\d.]+ \| [\d.]+ x \|",
    ),
    "filters": (
        "--rows 2000 --dimension 32 --selectivities 0.001 0.5 1 --factories IVF16,SQ8",
        r"\| 0.5 \| 1,000 \| IVF16,SQ8 \| [\d.]+ \|.* [\d.]+ x \|",
    ),
    "ingredients": (
        "--shards {tiny} --held places={tiny} --out {out} --epochs 1 --batch-size 2 "
        "--only without_turns",
        r"without_turns \| [\d.]+% \[.*\] \| [+-][\d.]+% \[",
    ),
    "matchers": (
        "--tiles {adapted}/region/tiles --index {adapted}/region/index "
        "--flight {adapted}/region/flights/check/photos.csv --photos 1 --features sift dense",
        r"\| sift \| yes \| [\d.]+% .* 1.00 x \|(.|\n)*\| dense \| yes \| .* [\d.]+ x \|"
        r"(.|\n)*whole map, no tags: [\d.]+%",
    ),
    "own_map": (
        "--imagery {images} --out {out} --tiles 3 --photos 1 --height 12 16 --higher 1.5 "
        "--levels 55 110",
        r"built-in, matched, pose: [\d.]+% within 1 m, .* of 1 photos, [\d.]+ x ImageNet's tiles"
        r"(.|\n)*\| 18 to 24 \| no \| levels \|(.|\n)*levels, .* [\d.]+ x one level's photos",
    ),
    "promise": (
        "--out {adapted} --days 1 --photos 1 --height 60 80 --pitch -90 -75 --tags without",
        r"\| day 1, without \| .* [\d.]+ x \|(.|\n)*within 25 m: promised .* points too much",
    ),
    "region": (
        "--out {adapted} --side 400 --resolution 0.5 --minutes 0.01 --photos 1 --checks 20 "
        "--height 60 80 --pitch -90 -75 --tile-m 55 110 --tags without",
        r"\| after, without \| [\d.]+% \|.* [\d.]+ x \|(.|\n)*"
        r"\| plain SIFT over the whole map, without .* [\d.]+ x \|",
    ),
    "relight": (
        "--towns 1 --side 120 --resolution 1",
        r"unexplained of another day: [\d.]+ x that with the map's own light",
    ),
    "serve": (
        "--checkpoint {trained}/run/last.pt --index {trained}/index "
        "--photos {trained}/flights/test/query_drone --clients 2 --seconds 0.2 --rounds 1 "
        "--threads 1",
        r"batching [\d.]+ x the photos/s",
    ),
    "shards": ("--images 20 --side 64 --repeats 1", r"two tasks takes [\d.]+ x tar's time"),
    "simulate": ("--sizes 64 --views 1", r"[\d.]+ x the time of encoding them as JPEG"),
    "streaming": (
        "--distinct 2 --few 20 --many 40",
        r"peak memory of 40 images streamed: [\d.]+ x that of 20",
    ),
    "tracks": (
        "--region {adapted}/region --over {adapted}/map/another_day.tif "
        "--surface {adapted}/map/surface.tif --out {out} --flights 1 --photos 2 "
        "--height 60 80 --pitch -90 -75 --ways tiles odometry-online",
        r"\| tiles \| [\d.]+% \|(.|\n)*\| odometry-online \| .* [\d.]+ x \|",
    ),
    "train_step": (
        "--cases smoke --steps 1 --rounds 1",
        r"streamed step .* [\d.]+ x the resident step",
    ),
    "unlabelled": (
        "--shards {tiny} --held places={tiny} --out {out} --rounds 1 --neighbours 9 "
        "--round-epochs 1 --batch-size 2 --seeds 1",
        r"with_the_adversary \| [\d.]+% \[.*\] \| [+-][\d.]+% \[.* \| \d+%",
    ),
    "vamana": (
        "--rows 600 --dimension 32 --rounds 1 --seconds 0.05 --factories HNSW32,SQ8 IVF8,SQ8",
        r"IVF8,SQ8 \| [\d.]+ \| [\d,]+ \| [\d.]+ x",
    ),
}
"Script -> arguments of its smallest size, and a line that it has to print."
LOCATE = (
    "--textures {images} --out {trained} --epochs 1 --hold-out 0.35 --train-locations 28 "
    "--test-locations 3 --distractors 7 --flights 1 --stops 3 --draws 1"
)


def run(launcher: Launcher, name: str, arguments: str, **folders: Path) -> str:
    """Run a benchmark to its end on the session's Ray; its output."""
    address: str = ray.get_runtime_context().gcs_address
    words = arguments.format(**folders).split()
    result = launcher.start(name, words, folder="benchmarks", RAY_ADDRESS=address).end()
    assert result.code == 0, result.output[-3000:]
    return result.output


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Overhead images, synthetic."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(FOLDER))
        from synthetic import jpegs
    del sys.modules["synthetic"]
    folder = tmp_path_factory.mktemp("images")
    for number, data in enumerate(jpegs(38, 96, 96)):
        (folder / f"{number:03d}.jpg").write_bytes(data)
    return folder


@pytest.fixture(scope="module")
def trained(
    prepared: Launcher,
    ray_cluster: None,
    images: Path,
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[Path, str]:
    """The artefacts of benchmarks/locate.py, among them a checkpoint and an index; its output."""
    folder = tmp_path_factory.mktemp("locate")
    return folder, run(prepared, "locate", LOCATE, images=images, trained=folder)


def test_every_script_has_a_case() -> None:
    assert {path.stem for path in FOLDER.glob("*.py")} == {*CASES, "locate"} | HELPERS


def test_locate_compares_tracks_with_single_photos(trained: tuple[Path, str]) -> None:
    folder, output = trained
    assert re.search(r"ms per track of 3 photos, [\d.]+ x the time of their single", output), output
    assert re.search(r"1 photo: answered .* within 1 m, .* with a precision of 95%", output), output
    assert (folder / "reliability.svg").stat().st_size > 0


@pytest.mark.parametrize("name", CASES)
def test_script_prints_a_ratio(
    name: str,
    prepared: Launcher,
    ray_cluster: None,
    request: pytest.FixtureRequest,
    tmp_path: Path,
) -> None:
    arguments, expected = CASES[name]
    folders: dict[str, Path] = {"out": tmp_path}
    if "{images}" in arguments:
        folders["images"] = request.getfixturevalue("images")
    if "{tiny}" in arguments:
        folders["tiny"] = Path(request.getfixturevalue("tiny_shards"))
    if "{adapted}" in arguments:
        folders["adapted"] = Path(request.getfixturevalue("adapted_region").out).parent
    if "{trained}" in arguments:
        folders["trained"] = request.getfixturevalue("trained")[0]
    output = run(prepared, name, arguments, **folders)
    assert re.search(expected, output), output[-3000:]


def test_gpu_keeps_finished_measurements_and_stops_in_time(
    prepared: Launcher, tmp_path: Path
) -> None:
    """With no time left, kept figures are printed and the others are named; nothing is measured."""
    settings: dict[str, object] = {
        "width": 1.0,
        "size": 256,
        "rounds": 3,
        "seconds": 4.0,
        "compiling": "always",
    }
    settings |= dict.fromkeys(("batch", "train_batch", "steps", "decoders"))
    settings |= {"compile_training": False}
    figures = {
        "how": "8 + 8", "images_per_second": 90.0, "resident_images_per_second": 120.0,
        "peak_memory_mb": 5.0, "memory_of": "the process's",
    }  # fmt: skip
    kept = {"settings": settings, "hardware": "a GPU", "date": "2026-01-02", "figures": figures}
    names = ("training, ResNet-50", "training, built-in")
    other = kept | {"settings": settings | {"size": 128}}
    (tmp_path / "gpu.json").write_text(json.dumps(dict(zip(names, (kept, other), strict=True))))
    words = ["--out", str(tmp_path), "--minutes", "0"]
    result = prepared.start("gpu", words, folder="benchmarks").end()
    assert result.code == 1, result.output
    assert "training, ResNet-50: 90.0 images/s, 0.750 x the resident loop's 120.0" in result.output
    assert "| training, ResNet-50, 8 + 8 | 90.0 | 120.0 | 0.750 |" in result.output
    assert "training, built-in: not measured: stopped by --minutes" in result.output
    assert "| training, built-in" not in result.output
