"""A checkpoint's encoder as one small file without training's state, to share.

In: a checkpoint. Out: a .safetensors file that every `--checkpoint` and `train --weights` takes.
"""

from jobs.encoding.encoder import read_checkpoint_bytes
from jobs.stages.settings import ExportWeightsSettings
from model.checkpoint import dumps_encoder, loads
from pipeline.core import storage
from pipeline.core.progress import console


def export_weights(settings: ExportWeightsSettings) -> str:
    """Write the encoder and return its path; an existing file is replaced.

    Raises InputError or CheckpointError on unusable input.
    """
    out = storage.absolute(settings.out)
    data = read_checkpoint_bytes(settings.checkpoint)
    encoder = dumps_encoder(loads(data, settings.checkpoint))
    storage.write_bytes(out, encoder)
    console.print(
        f"{out}: {len(encoder) / 1e6:.1f} MB, of a checkpoint of {len(data) / 1e6:.1f} MB"
    )
    return out
