"""The encoder of a region: the built-in one, fine-tuned on pairs over the map where that helps."""

import json
import math

from jobs.encoding.embed_test import embed_test
from jobs.region.flights import pack_pairs
from jobs.region.folder import Region
from jobs.stages.export_weights import export_weights
from jobs.stages.settings import ExportWeightsSettings
from jobs.training.checkpoints import METRICS_FILE
from jobs.training.driver import train
from jobs.training.recipes.builtin import finetune
from jobs.training.settings import TrainSettings
from model.weights.builtin import BUILTIN
from pipeline.core import json_files, storage
from pipeline.core.progress import console
from pipeline.evaluation.evaluate import evaluate
from pipeline.evaluation.settings import EvaluationSettings


def choose_encoder(region: Region, minutes: float, learn: str, choose: str) -> None:
    """Fine-tune within the minutes, and keep what ranks the held-out places better: an adapted
    encoder is never worse there than the built-in one."""
    if storage.exists(region.encoder):
        return
    chosen = BUILTIN
    if minutes > 0:
        shards = pack_pairs(learn)
        tuned = train(
            TrainSettings(
                recipe=finetune(_epochs(region, minutes, shards)), shards=shards, workers=0,
                out=region.path("run"),
            )
        )  # fmt: skip
        test = pack_pairs(choose)
        before, after = (
            _held_out_ap(region, test, name, checkpoint)
            for name, checkpoint in (("built-in", BUILTIN), ("tuned", tuned))
        )
        chosen = tuned if after >= before else BUILTIN
        console.print(
            f"places not learned, UAV -> map: AP {before:.1%} before, {after:.1%} after; "
            f"{'the tuned' if chosen == tuned else 'the built-in'} encoder is kept"
        )
    export_weights(ExportWeightsSettings(checkpoint=chosen, out=region.encoder))


def _epochs(region: Region, minutes: float, shards: str) -> int:
    """Epochs that fit the minutes: by a first one, which is timed and thrown away."""
    path = region.path("epochs.json")
    if storage.exists(path):
        return int(json_files.read_checksummed(path)["epochs"])
    trial = region.path("trial")
    train(TrainSettings(recipe=finetune(1), shards=shards, workers=0, out=trial))
    row = json.loads(storage.read_bytes(storage.join(trial, METRICS_FILE)))
    epochs = max(1, math.floor(60 * minutes / float(row["seconds"])) - 1)
    json_files.write_checksummed(path, {"epochs": epochs, "seconds_per_epoch": row["seconds"]})
    storage.remove_folder(trial)
    return epochs


def _held_out_ap(region: Region, shards: str, name: str, checkpoint: str) -> float:
    """Average precision of UAV -> map over the places held out, by an encoder."""
    table = region.path("choose", name, "table")
    embed_test(shards, checkpoint, table)
    out = region.path("choose", name, "evaluation")
    rows = evaluate(
        EvaluationSettings(
            out=out, queries=table, gallery=table, query_view="drone", gallery_view="satellite",
            shards=shards, title=f"Places not learned, {name} encoder",
        )
    )  # fmt: skip
    return float(rows[0]["ap"])
