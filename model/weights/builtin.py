"""The built-in encoder: its weights are a file of this package.

In: nothing. Out: the bytes of a checkpoint, as `model.checkpoint.loads` reads it. What it was
trained on, and what it is good for, is in docs/model_card.md.
"""

from pathlib import Path

from model.errors import CheckpointError

BUILTIN = "builtin"
"What a command line calls it: `--checkpoint builtin`."
PATH = Path(__file__).with_name("builtin.safetensors")


def read_builtin() -> bytes:
    """The bytes of the built-in encoder. Raises CheckpointError where the file is missing."""
    try:
        return PATH.read_bytes()
    except FileNotFoundError:
        raise CheckpointError(
            f"{PATH} is missing, expected the built-in encoder that comes with this project; "
            "install it again"
        ) from None
