"""The encoder of a region: the built-in one, fine-tuned on pairs over the map, and aligned with the
UAV's own photos, where that helps."""

import json
import math
from collections.abc import Callable

from jobs.encoding.embed_test import embed_test
from jobs.region.alignment import align
from jobs.region.flights import pack_pairs
from jobs.region.folder import Region
from jobs.region.settings import AdaptSettings
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


def choose_encoder(region: Region, settings: AdaptSettings, learn: str, choose: str) -> None:
    """Fine-tune within the minutes, align with the UAV's own photos where there are enough, and
    keep each step that does not rank the held-out places worse: an adapted encoder is never worse
    there than the built-in one."""
    if storage.exists(region.encoder):
        return
    chosen = BUILTIN
    if settings.minutes > 0:
        test = pack_pairs(choose)
        best = _held_out_ap(region, test, "built-in", BUILTIN)
        steps: dict[str, Callable[[str], str | None]] = {
            "tuned": lambda _: tune(region, settings.minutes, learn),
            "aligned": lambda start: align(region, settings, start),
        }
        for name, make in steps.items():
            made = make(chosen)
            if made is None:
                continue
            after = _held_out_ap(region, test, name, made)
            kept = after >= best
            console.print(
                f"places not learned, UAV -> map: AP {best:.1%} before, {after:.1%} {name}; "
                f"the {name} encoder is {'kept' if kept else 'not kept'}"
            )
            if kept:
                chosen, best = made, after
    export_weights(ExportWeightsSettings(checkpoint=chosen, out=region.encoder))


def tune(region: Region, minutes: float, learn: str) -> str:
    """Fine-tune the built-in encoder on a flight's pairs within the minutes; the checkpoint."""
    shards = pack_pairs(learn)
    return train(
        TrainSettings(
            recipe=finetune(_epochs(region, minutes, shards)), shards=shards, workers=0,
            out=region.path("run"),
        )
    )  # fmt: skip


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
