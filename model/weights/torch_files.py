"""Bytes of a file that torch wrote -> what is in it: no code runs, nothing is inflated, and tensors
hold what they say.

In: bytes from anybody. Out: plain values and tensors, or a ValueError. torch raises many other
kinds over a damaged file.
"""

import io
import zipfile
from typing import Any

import torch
from torch import Tensor


def read(data: bytes) -> Any:
    """What `torch.save` wrote. Raises ValueError, and whatever torch does."""
    if zipfile.is_zipfile(io.BytesIO(data)):
        with zipfile.ZipFile(io.BytesIO(data)) as parts:
            require_uncompressed(parts, len(data))
    found = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    require_full_tensors(found)
    return found


def require_uncompressed(parts: zipfile.ZipFile, size: int) -> None:
    """Raise ValueError where a zip of `size` bytes holds more than these.

    torch writes records as they are: one that inflates may be of any size, and so may many that
    overlap.
    """
    held = parts.infolist()
    if (
        any(part.compress_type != zipfile.ZIP_STORED for part in held)
        or sum(part.file_size for part in held) > size
    ):
        raise ValueError("it is packed in another way than torch does")


def require_full_tensors(value: Any) -> None:
    """Raise ValueError where a tensor says that it is larger than what is there: one number may be
    strided into any shape.
    """
    seen, waiting = set[int](), [value]
    while waiting:
        value = waiting.pop()
        if id(value) in seen:  # a pickle may name one list many times, within itself too
            continue
        seen.add(id(value))
        if isinstance(value, dict):
            waiting += [*value.keys(), *value.values()]
        elif isinstance(value, list | tuple | set | frozenset):
            waiting += value
        elif isinstance(value, Tensor):
            whole = (
                value.layout == torch.strided
                and value.device.type == "cpu"
                and not value.is_quantized
            )
            if not whole or value.untyped_storage().nbytes() < value.numel() * value.element_size():
                raise ValueError("it holds a tensor that is not there in full")
