"""Answer over HTTP where photos were taken: `serve.py --checkpoint FILE --index INDEX [--host H]
[--port P]`
"""

import asyncio
import os
import signal
from functools import partial

import cv2
import torch
from aiohttp import web

from jobs.encoding.encoder import (
    absolute_checkpoint,
    read_checkpoint_bytes,
    require_checkpoint,
)
from jobs.encoding.localizer import with_localizer
from jobs.encoding.photo_encoder import PhotoEncoder
from jobs.stages.matching import open_photo_map
from jobs.stages.settings import ServeSettings
from model.errors import CheckpointError
from pipeline.core import cluster, storage
from pipeline.core.cluster import plan_placement
from pipeline.core.errors import InputError
from pipeline.core.progress import console
from pipeline.index.metadata import METADATA_FILE, IndexMetadata
from pipeline.service.app import Service
from pipeline.service.batcher import ReplicaLost
from pipeline.service.engine import NotReady
from pipeline.service.live_index import POLL_INTERVAL_S
from pipeline.service.photo_map import no_map
from pipeline.service.predictor import Predictor
from pipeline.service.replicas import Replicas

WORTH_A_SECOND = 2000
"""Photos that the encoder is made for: OpenVINO's second pays, and torch.compile's half a minute
would delay the start."""


def load_predictor(
    checkpoint: str,
    index: str,
    shards: str | None,
    threads: int,
    match: bool = True,
    dense: bool = True,
    surface: str | None = None,
) -> Predictor:
    """Load the encoder, the index and the map's pixels; called on each replica. Raises
    InputError."""
    torch.set_num_threads(threads)  # FAISS takes OMP_NUM_THREADS, which Ray sets to the cores
    cv2.setNumThreads(threads)
    open_map = (
        no_map if shards is None else partial(open_photo_map, shards, match, dense, index, surface)
    )

    def encoder_for(metadata: IndexMetadata) -> PhotoEncoder:
        try:
            data = read_checkpoint_bytes(checkpoint)
            return PhotoEncoder(
                data, checkpoint, metadata.fingerprint, metadata.encoding, images=WORTH_A_SECOND
            )
        except CheckpointError as error:
            raise InputError(str(error)) from None

    return Predictor(index, encoder_for, open_map)


def serve(settings: ServeSettings) -> None:
    """Answer over HTTP where photos were taken, until Ctrl-C or SIGTERM."""
    settings = with_localizer(settings)
    require_checkpoint(settings.checkpoint)
    path = storage.join(settings.index, METADATA_FILE)
    if not storage.is_file(path):
        raise InputError(
            f"no index at {path}; expected an index of jobs/build_index.py; check --index"
        )
    token = settings.token()
    cluster.connect()
    asyncio.run(listen(settings, token))


async def listen(settings: ServeSettings, token: str | None) -> None:
    """Listen at once, so that /health can report that it is loading; answer once it has loaded."""
    placement = plan_placement(
        cluster.nodes(), settings.replicas, settings.replicas, settings.threads
    )
    shards = None if settings.shards is None else storage.absolute(settings.shards)
    surface = None if settings.surface is None else storage.absolute(settings.surface)
    checkpoint = absolute_checkpoint(settings.checkpoint)
    index = storage.absolute(settings.index)
    make_predictor = partial(
        load_predictor,
        checkpoint,
        index,
        shards,
        placement.cpus,
        settings.match,
        settings.dense,
        surface,
    )
    replicas = Replicas(f"pvda-{os.getpid()}", placement, make_predictor)
    runner = Service(settings, replicas, token, concurrency=placement.workers).runner()
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    await runner.setup()
    try:
        site = web.TCPSite(runner, settings.host, settings.port)
        try:
            await site.start()
        except OSError as error:
            raise InputError(
                f"cannot listen on {settings.host} port {settings.port}: {error.strerror}; choose "
                "another --port"
            ) from None
        console.print(f"http://{settings.host}:{site.port} listens; loading")
        watching = asyncio.create_task(watch_replicas(replicas))
        stopping = asyncio.create_task(stop.wait())
        await asyncio.wait([watching, stopping], return_when=asyncio.FIRST_COMPLETED)
        if watching.done():
            watching.result()  # it ends only by an exception
        console.print("stopping")
        watching.cancel()
    finally:
        await runner.cleanup()
        await asyncio.to_thread(replicas.stop)


async def watch_replicas(replicas: Replicas) -> None:
    """Load, then print each change of the index in use: replicas themselves print nothing."""
    known = await asyncio.to_thread(replicas.start)
    console.print(
        f"ready: {known.rows} rows, {known.factory}, encoder {known.fingerprint[:12]}, "
        + ("photos are matched with the map" if known.matched else "positions are those of tiles")
        + "; Ctrl-C ends it"
    )
    while True:
        await asyncio.sleep(POLL_INTERVAL_S)
        try:
            status = await replicas.status()
        except (NotReady, ReplicaLost):  # another replica is starting
            continue
        if status != known:
            changed = f"another index is in use: {status.rows} rows, {status.factory}"
            console.print(status.refused or changed, style="yellow" if status.refused else None)
            known = status
