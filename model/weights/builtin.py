"""The built-in encoder and the head of its dense features: their weights are files of this package.

In: nothing. Out: the bytes of a checkpoint, as `model.checkpoint.loads` reads it, and of a head's
tensors. What they were trained on, and what they are good for, is in docs/model_card.md.
"""

from pathlib import Path

from model.errors import CheckpointError

BUILTIN = "builtin"
"What a command line calls it: `--checkpoint builtin`."
PATH = Path(__file__).with_name("builtin.safetensors")
DENSE_PATH = Path(__file__).with_name("dense_head.safetensors")


def read_builtin() -> bytes:
    """The bytes of the built-in encoder. Raises CheckpointError where the file is missing."""
    return _read(PATH, "the built-in encoder")


def read_dense_head() -> bytes:
    """The bytes of the head of `model/dense.py`. Raises CheckpointError where the file is
    missing."""
    return _read(DENSE_PATH, "the head of the built-in encoder's dense features")


def _read(path: Path, what: str) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise CheckpointError(
            f"{path} is missing, expected {what} that comes with this project; install it again"
        ) from None
