"""Strategies of command lines: every job with flags of any value, and none that works."""

from hypothesis import strategies as st

NUMBERS = [
    "0",
    "-1",
    "1",
    "nan",
    "inf",
    "-inf",
    "1e309",
    "1e-320",
    str(10**12),
    str(2**63),
    str(10**30),
    "1.5",
    "",
    " ",
    "x",
    "1_0",
    "0x1",
    "None",
    "١",
    "--",
    "true",
]
TEXTS = [
    "",
    " ",
    "None",
    "a\nb",
    "[/]",
    "é",
    "%s",
    "{0}",
    "*",
    "x" * 5000,
    "--help",
    "-1",
    "IVF1000000000,Flat",
    "IVF0,PQ0",
    "10 bananas",
    "-4GB",
    "1e30GB",
    "EPSG:1",
]
PATHS = [
    "missing",
    "file",
    "empty",
    "junk",
    "file/below",
    "",
    ".",
    "~nobody/x",
    "a\nb",
    "\udcff",
    "x" * 300,
    "foo://x",
    "memory://x",
    "memory://",
    "http://127.0.0.1:9/x",
    "s3://x/y",
    "file:///nowhere",
    "::",
    "a::b://c",
    "link",
    "fifo",
]
INSIDE = [
    "empty",
    "junk",
    "file",
    "new",
    "new/deep",
    "file/below",
    "",
    "foo://x",
    "link",
    "x" * 300,
    "loop",
]
"""Valid outputs: none that would survive the test, none in another process's storage."""

# inputs, outputs, numbers, texts
JOBS: dict[str, tuple[list[str], list[str], list[str], list[str]]] = {
    "simulate": (
        ["textures"],
        ["out"],
        [
            "train-locations",
            "test-locations",
            "distractors",
            "views",
            "size",
            "seed",
            "texture-metres-per-pixel",
        ],
        [],
    ),
    "make_shards": (
        ["root"],
        ["out"],
        ["samples-per-shard", "megabytes-per-shard", "max-bad-fraction", "workers"],
        ["check"],
    ),
    "train": (
        ["shards", "weights"],
        ["out"],
        [
            "workers",
            "keep",
            "checkpoint-minutes",
            "probe-epochs",
            "gpus-per-worker",
            "max-failures",
        ],
        [],
    ),
    "embed_gallery": (
        ["shards", "checkpoint"],
        ["out"],
        ["batch-size", "workers", "cpus-per-worker", "gpus-per-worker", "patience"],
        ["split", "view", "dtype"],
    ),
    "build_index": (
        ["table"],
        ["out"],
        ["target-recall", "parts", "workers"],
        ["memory-budget", "factory", "split"],
    ),
    "calibrate": (
        ["checkpoint", "shards", "index"],
        ["out"],
        ["tolerance", "outside", "photos"],
        ["view"],
    ),
    "locate": (
        ["checkpoint", "index", "times", "calibration", "shards"],
        ["out", "csv", "page"],
        ["top", "max-speed", "elsewhere", "interval"],
        [],
    ),
    "serve": (
        ["checkpoint", "index", "token-file"],
        [],
        [
            "port",
            "max-megabytes",
            "max-megapixels",
            "batch",
            "waiting",
            "timeout-s",
            "replicas",
            "threads",
        ],
        ["host"],
    ),
    "evaluate": (
        ["table", "shards", "run", "beside"],
        ["out"],
        ["panels", "workers"],
        ["protocol", "query-view", "title", "by"],
    ),
    "compare": ([], ["out"], [], []),
    "import_features": (["mat"], ["out"], [], ["query-view"]),
    "import_weights": (["torchvision", "lpn", "mccg", "qdfl"], ["out"], ["image-size"], []),
    "export_weights": (["checkpoint"], ["out"], [], []),
}
SOURCES = {
    "university1652": ["kml", "views"],
    "sues200": ["heights"],
    "denseuav": [],
    "gta-uav": ["division", "pairs"],
    "visloc": ["tile-pixels", "overlap", "train-flights"],
    "photos": ["view", "split", "location", "geotags"],
    "geotiff": [
        "tile-m",
        "tile-pixels",
        "overlap",
        "output-pixels",
        "max-nodata",
        "crs",
        "resampling",
    ],
    "xyz": ["zoom", "view"],
    "table": ["view", "split"],
    "nothing": [],
    "": [],
}
RECIPES = ["smoke", "paper", "lpn", "nothing", "", "--help", "-x"]
OVERRIDES = [
    "batch-size",
    "seed",
    "image-size",
    "backbone",
    "width",
    "parts",
    "part-dim",
    "epochs",
    "hold-out",
    "dropout",
    "threads",
    "shuffle-buffer",
    "learning-rate",
    "pad",
]


@st.composite
def line(draw: st.DrawFn) -> tuple[str, list[str]]:
    name = draw(st.sampled_from(list(JOBS)))
    inputs, outputs, numbers, texts = JOBS[name]
    words: list[str] = []
    if name == "make_shards":
        source = draw(st.sampled_from(list(SOURCES)))
        words += ["--source", source] if draw(st.integers(0, 9)) else [f"--source={source}"]
        for flag in SOURCES[source]:
            if not draw(st.integers(0, 2)):
                words += [f"--{flag}", draw(st.sampled_from(NUMBERS + TEXTS))]
    if name == "train":
        words += [draw(st.sampled_from(RECIPES))]
        for flag in OVERRIDES:
            if not draw(st.integers(0, 9)):
                words += [f"--{flag}", draw(st.sampled_from(NUMBERS))]
    for flag in inputs:
        if draw(st.integers(0, 3)):
            words += [f"--{flag}", draw(st.sampled_from(PATHS[:-1]))]
    for flag in outputs:
        if draw(st.integers(0, 9)):
            words += [f"--{flag}", draw(st.sampled_from(INSIDE + ([] if flag != "out" else ["."])))]
    for flag in numbers:
        if not draw(st.integers(0, 5)):
            words += [f"--{flag}", draw(st.sampled_from(NUMBERS))]
    for flag in texts:
        if not draw(st.integers(0, 4)):
            words += [f"--{flag}", draw(st.sampled_from(TEXTS))]
    if name == "simulate":
        words += (
            ["--size", "31"] if draw(st.booleans()) else ["--textures", "empty"]
        )  # it makes towns of anything else
        words += (
            ["--train-locations", "1", "--test-locations", "1", "--distractors", "1"]
            if draw(st.booleans())
            else []
        )
    if name in ("locate", "compare"):
        words += draw(st.lists(st.sampled_from(PATHS[:-1]), max_size=2))
        if not draw(st.integers(0, 4)):
            words += ["--near", *draw(st.lists(st.sampled_from(NUMBERS), min_size=3, max_size=3))]
    return name, words
