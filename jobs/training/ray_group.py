"""Training by a group of Ray Train workers, and what to do when one of them dies.

In: a run and the number of workers. Out: the run's folder, as one worker in this process would
write it; messages of the workers on the terminal.
"""

import threading
from contextlib import suppress
from dataclasses import replace
from itertools import count
from typing import Any

import ray.train
import torch
from ray.exceptions import RayActorError
from ray.train import ScalingConfig, WorkerGroupError, get_context
from ray.train.torch import TorchTrainer, get_device
from ray.util.queue import Empty, Queue
from torch import nn
from torch.nn.parallel import DistributedDataParallel

from jobs.training.settings import RunConfig, TrainSettings
from jobs.training.state import DamageCount, Shared, WorkerContext
from jobs.training.worker import train_worker
from model.errors import CheckpointError
from pipeline.core import cluster
from pipeline.core.errors import Incomplete, InputError
from pipeline.core.progress import Meter

NOT_NEEDED = ("DatasetsCallback", "PlacementGroupCleanerCallback")
"""Of Ray Train, each with a process that takes seconds to start: one hands out data sets of Ray
Data, of which a run has none; one frees what a dead controller leaves, as the job's end does."""
NOT_ASKED = ("_send_resource_request", "_maybe_send_resource_request", "_cancel_resource_request")
"""Of Ray Train's scaling policy: it starts one more such process to ask an autoscaler for workers,
which their placement group asks for anyway while it waits."""
QUEUE_POLL_S = 1.0
"Timeout of one poll of the queue that carries the workers' messages."


def train_on_ray(run: RunConfig, settings: TrainSettings, meter: Meter) -> None:
    """Train with Ray Train's workers. When one dies, the group is started again and resumes from
    the last checkpoint.

    Not by Ray Train's own FailureConfig: that would retry a run that has diverged, and nobody would
    hear of it. Where Ray Train's controller dies, the job ends (RayActorError): its placement group
    may stay reserved until then.
    """
    cluster.connect()
    gpus = settings.gpus_per_worker
    if gpus is None:
        gpus = 1.0 if cluster.gpus() >= settings.workers else 0.0
    if run.recipe.sync_bn and settings.workers > 1 and not gpus:
        raise InputError(
            f"sync_bn is on and {settings.workers} workers have no GPUs, expected GPUs: torch "
            "synchronises BatchNorm on those alone; leave sync_bn off, or train with --workers 1"
        )
    cpus = max(1, cluster.cpus() // settings.workers)
    scaling = ScalingConfig(
        num_workers=settings.workers,
        use_gpu=gpus > 0,
        resources_per_worker={"CPU": cpus} | ({"GPU": gpus} if gpus else {}),
    )
    for failures in count(1):
        try:
            train_group(run, scaling, cpus, meter)
            break
        except WorkerGroupError as error:
            if failures > settings.max_failures:
                raise
            kinds = {type(failure).__name__ for failure in error.worker_failures.values()}
            meter.note(
                f"lost a worker ({', '.join(sorted(kinds))}); resuming from the last checkpoint, "
                f"{failures} of {settings.max_failures}"
            )


def train_group(run: RunConfig, scaling: ScalingConfig, cpus: int, meter: Meter) -> None:
    """Train with one group of workers; their messages come back through a queue.

    Raises the worker's own error where every other group would meet it too, WorkerGroupError where
    a worker died.
    """
    messages, refused = Queue(actor_options={"num_cpus": 0}), list[Exception]()
    listener = threading.Thread(target=listen, args=(messages, meter, refused), daemon=True)
    listener.start()
    trainer = _Trainer(
        ray_worker,
        train_loop_config={"run": run, "messages": messages, "cpus": cpus},
        scaling_config=scaling,
        # Ray Train's own records: checkpoints are written by rank 0, so that they are the same with
        # and without Ray.
        run_config=ray.train.RunConfig(name="ray", storage_path=run.out),
    )
    try:
        trainer.fit()
    except (WorkerGroupError, RayActorError):
        stop_listener(messages, listener)  # after the queue's last message
        if refused:
            raise refused[0] from None
        raise
    finally:
        stop_listener(messages, listener)
        with suppress(RayActorError):
            messages.shutdown()


def stop_listener(messages: Queue, listener: threading.Thread) -> None:
    """Let the listener read what is still in the queue, and end. Where the queue's actor was lost,
    it has ended already.
    """
    with suppress(RayActorError):
        messages.put(None)
    listener.join()


class _Trainer(TorchTrainer):
    """Ray Train's, without its handler of Ctrl-C: that one ends the process with code 1 from within
    a call, and stays installed. And without NOT_NEEDED and NOT_ASKED.
    """

    def _register_sigint_handler(self, controller: Any) -> None:
        pass

    def _create_default_callbacks(self) -> list[Any]:
        every: list[Any] = super()._create_default_callbacks()  # type: ignore[misc]
        return [one for one in every if type(one).__name__ not in NOT_NEEDED]

    def _initialize_and_run_controller(self, **parts: Any) -> Any:
        for name in NOT_ASKED:
            setattr(parts["scaling_policy"], name, lambda *_: None)
        return super()._initialize_and_run_controller(**parts)  # type: ignore[misc]


def ray_worker(config: dict[str, Any]) -> None:
    """A Ray Train worker: the same worker, with DDP around what is trained."""
    # Ray's OMP_NUM_THREADS has the same number; set on purpose.
    torch.set_num_threads(config["cpus"])
    train_context, device = get_context(), get_device()
    messages, rank = config["messages"], train_context.get_world_rank()
    if device.type == "cuda":
        torch.cuda.set_device(device)
    context = WorkerContext(
        rank=rank,
        world_size=train_context.get_world_size(),
        device=str(device),
        after_epoch=ray.train.report,
    )
    if context.world_size > 1:
        context = replace(
            context, wrap_ddp=wrap_ddp, broadcast=broadcast_from_first, gather=gather_damage
        )
    try:
        train_worker(config["run"], context, messages.put if rank == 0 else lambda message: None)
    except (Incomplete, InputError, CheckpointError) as error:
        messages.put({"refused": error})
        raise


def wrap_ddp(module: nn.Module) -> nn.Module:
    # BatchNorm's running statistics stay each worker's own during training (rank 0's are saved):
    # broadcasting them would write into buffers between the two forward passes of one step.
    return DistributedDataParallel(module, broadcast_buffers=False)


def broadcast_from_first(value: Shared) -> Shared:
    """What rank 0 has."""
    objects = [value]
    torch.distributed.broadcast_object_list(objects, src=0)
    return objects[0]


def gather_damage(damage: DamageCount) -> list[DamageCount]:
    """The counts of all workers, by rank."""
    counts: list[DamageCount] = [(0, None)] * torch.distributed.get_world_size()
    torch.distributed.all_gather_object(counts, damage)
    return counts


def listen(messages: Queue, meter: Meter, refused: list[Exception]) -> None:
    """Show the workers' messages until None comes or the queue's actor is lost; collect the errors
    that end the run.
    """
    message: dict[str, Any] | None = {}
    while message is not None:
        try:
            # With a timeout: an actor that got SIGTERM waits for its pending calls and answers none
            # of them meanwhile.
            message = messages.get(timeout=QUEUE_POLL_S)
        except Empty:
            continue
        except RayActorError:
            return
        if message and "refused" in message:
            refused.append(message["refused"])
        elif message:
            show_report(meter, message)


def show_report(meter: Meter, message: dict[str, Any]) -> None:
    """A worker's message on the terminal."""
    figures = dict(message)
    if "note" in figures:
        meter.note(figures["note"])
    else:
        meter.advance(figures.pop("steps"), **figures)
