"""The driver of a training run: validates the input, shows the settings, and starts the workers.

In: TrainSettings. Out: RUN/last.pt (weights, config, and all that resuming needs), RUN/config.yaml
(the settings, for `train --like RUN`), RUN/metrics.jsonl (a row per epoch) and RUN/tensorboard. A
killed run resumes from its last checkpoint when it is started again; where a Ray worker dies, by
itself. A step is reached over driver, worker, loop and `Training.step`.
"""

import torch

from jobs.command_line.config import flatten_settings, to_yaml
from jobs.training.checkpoints import CHECKPOINT_FILE, find_checkpoint
from jobs.training.config_table import print_config
from jobs.training.ray_group import show_report, train_on_ray
from jobs.training.settings import RECIPE, RUN_CONFIG_FILE, RunConfig, TrainSettings
from jobs.training.state import WorkerContext, open_stream
from jobs.training.worker import train_worker
from model.pvda import FeatureEncoder
from model.shapes_alone import shapes_alone, weights_follow
from model.weights.start import load_start
from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.lock import locks_output
from pipeline.core.progress import console, progress
from pipeline.core.records import Split
from pipeline.shards.shard_set import open_shards
from pipeline.shards.verify import require_intact


@locks_output(lambda settings: settings.out)
def train(settings: TrainSettings) -> str:
    """Train a recipe to its end and return the checkpoint's path; a finished run is left as it is.

    Raises InputError or CheckpointError on unusable input, before any worker starts.
    """
    run = settings.run
    path = storage.join(run.out, CHECKPOINT_FILE)
    found, epochs = find_checkpoint(run, console.print), run.recipe.schedule.epochs
    done, step = (found[1].epoch, found[1].step) if found is not None else (0, 0)
    if done == epochs:
        console.print(
            f"{path} is complete: {epochs} epochs of recipe {run.recipe.name}; nothing to do"
        )
        return path
    steps = check_input(settings, run, resumes=found is not None)
    if found is not None:
        within = f" and {step} of {steps} steps" if step else ""
        console.print(f"resuming after epoch {done} of {epochs}{within}")
    del found  # as large as the networks and their optimizers
    print_config(
        run.recipe, shards=run.shards, out=run.out, weights=run.weights, workers=settings.workers
    )
    write_config(settings, run)
    left = (epochs - done) * steps - step
    with progress(left, f"training {run.recipe.name}", "steps") as meter:
        if settings.workers == 0:
            use_gpu = torch.cuda.is_available() and settings.gpus_per_worker != 0
            context = WorkerContext(device="cuda" if use_gpu else "cpu")
            train_worker(run, context, lambda message: show_report(meter, message))
        else:
            train_on_ray(run, settings, meter)
    console.print(f"trained: {path}")
    return path


def check_input(settings: TrainSettings, run: RunConfig, resumes: bool) -> int:
    """Validate network, shards and weights; returns the steps of an epoch.

    Raises InputError or CheckpointError.
    """
    try:
        with shapes_alone():
            FeatureEncoder(run.recipe.network)
    except ValueError as error:  # a width or an image size that this backbone cannot have
        raise InputError(str(error)) from None
    shards = open_shards(run.shards)
    if settings.verify:
        require_intact(shards, None if settings.workers else 0)
    else:
        shards.require_tars(shards.manifest.of(Split.TRAIN))
    steps = open_stream(run, WorkerContext(world_size=max(1, settings.workers))).steps
    if not resumes and (run.weights is not None or run.recipe.start != "random"):
        with weights_follow():  # it is only asked whether they fit
            encoder = FeatureEncoder(run.recipe.network)
        load_start(encoder, run.recipe.network.backbone, run.recipe.start, run.weights)
    return steps


def write_config(settings: TrainSettings, run: RunConfig) -> None:
    """Write RUN/config.yaml: all settings but `out`, which another run names for itself."""
    entries = flatten_settings(settings, RECIPE) | {"shards": run.shards, "weights": run.weights}
    del entries["out"]
    storage.write_bytes(storage.join(run.out, RUN_CONFIG_FILE), to_yaml(entries).encode())
