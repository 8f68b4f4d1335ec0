"""UAV images laid on the ground: training sees them so, and the encoder's table records it."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from jobs.encoding.encoder import make_encoder_spec
from jobs.encoding.photo_encoder import PhotoEncoder
from jobs.encoding.settings import EncoderSettings
from jobs.training.driver import train
from jobs.training.settings import RunConfig
from jobs.training.state import WorkerContext, open_stream
from pipeline.batches.ordered import open_image
from pipeline.core.records import Split, View
from pipeline.features.embed import embed_gallery
from pipeline.features.encoding import encode_config, parse_config
from pipeline.features.settings import EmbeddingSettings
from pipeline.features.table import open_table
from pipeline.shards.shard_set import open_shards
from tests.jobs.tiny_runs import initial_checkpoint, settings, tiny


def test_training_sees_uav_images_from_above(tiny_shards: str) -> None:
    recipe = replace(tiny(1), augmentation=replace(tiny(1).augmentation, mirror=False))
    batches = {}
    for perspective in ("as_taken", "overhead"):
        seen = replace(recipe, perspective=perspective)
        stream = open_stream(RunConfig(shards=tiny_shards, out="x", recipe=seen), WorkerContext())
        batches[perspective] = next(iter(stream.epoch(0)))
    taken, above = batches["as_taken"], batches["overhead"]
    assert taken[0].keys == above[0].keys
    assert not np.array_equal(taken[0].images_B3HW, above[0].images_B3HW)
    assert np.array_equal(taken[1].images_B3HW, above[1].images_B3HW)


def test_table_records_the_perspective_of_training(tiny_shards: str, tmp_path: Path) -> None:
    recipe = replace(tiny(1), perspective="overhead", name="pcl_style")
    path = train(settings(tiny_shards, tmp_path / "run", recipe, probe_epochs=1))
    data = Path(path).read_bytes()
    tables, specs = {}, {}
    for name, given in (
        ("above", EncoderSettings()),
        ("taken", EncoderSettings(perspective="as_taken")),
    ):
        embedding = EmbeddingSettings(
            shards=tiny_shards, out=str(tmp_path / name), split=Split.QUERY, workers=0
        )
        specs[name] = make_encoder_spec(data, path, embedding, given)
        embed_gallery(embedding, specs[name])
        tables[name] = open_table(embedding.out)
    assert specs["above"].encoding.perspective == "overhead"
    assert specs["above"].fingerprint != specs["taken"].fingerprint
    assert parse_config(encode_config(specs["above"].encoding)) == specs["above"].encoding
    for view in (View.DRONE, View.SATELLITE):
        above, taken = (
            tables[name].select(Split.QUERY, view).embeddings() for name in ("above", "taken")
        )
        assert np.allclose(above, taken, atol=1e-5) is (view == View.SATELLITE)
    encoder = PhotoEncoder(data, path, specs["above"].fingerprint, specs["above"].encoding)
    shards = open_shards(tiny_shards)
    [shard] = shards.manifest.of(Split.QUERY, View.DRONE)[:1]
    sample = next(shards.samples(shard))
    rows_BD, _ = encoder.encode([sample.data], geotags=[sample.metadata["geotag"]])
    drones = tables["above"].select(Split.QUERY, View.DRONE)
    at = drones.labels().keys.tolist().index(sample.key)
    assert np.allclose(rows_BD[0], drones.embeddings()[at], atol=1e-4)
    image_HW3 = encoder.to_input(open_image(sample, "overhead"))
    assert np.allclose(encoder.forward([image_HW3])[0], rows_BD[0], atol=1e-5)


def test_encodings_from_before_have_no_perspective(tiny_shards: str) -> None:
    old = parse_config('{"mirror": true, "resizer": "torch", "precision": "float32"}')
    assert old is not None
    assert old.perspective == "as_taken"
    run = RunConfig(shards=tiny_shards, out="none", recipe=tiny(1))
    embedding = EmbeddingSettings(shards=tiny_shards, out="none")
    spec = make_encoder_spec(initial_checkpoint(run), "last.pt", embedding)
    assert spec.encoding.perspective == "as_taken"
