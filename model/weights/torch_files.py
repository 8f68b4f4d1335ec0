"""Reading files that torch wrote, from untrusted sources: no code runs, nothing is decompressed,
and every tensor has the memory that its shape claims.

In: bytes. Out: plain values and tensors, or a ValueError; torch raises many other kinds over a
damaged file.
"""

import io
import zipfile
from typing import Any

import torch
from torch import Tensor


def read(data: bytes) -> Any:
    """The value that `torch.save` wrote. Raises ValueError, and torch's own errors."""
    if zipfile.is_zipfile(io.BytesIO(data)):
        with zipfile.ZipFile(io.BytesIO(data)) as parts:
            require_uncompressed(parts, len(data))
    found = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    require_full_tensors(found)
    return found


def require_uncompressed(parts: zipfile.ZipFile, size: int) -> None:
    """Raise ValueError where a zip of `size` bytes unpacks to more.

    torch stores records uncompressed: a compressed one may have any size, and so may records that
    overlap.
    """
    records = parts.infolist()
    if (
        any(part.compress_type != zipfile.ZIP_STORED for part in records)
        or sum(part.file_size for part in records) > size
    ):
        raise ValueError("it is packed in another way than torch does")


def require_full_tensors(value: Any) -> None:
    """Raise ValueError where a tensor's shape exceeds its memory: one number may be strided into
    any shape.
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
            plain = (
                value.layout == torch.strided
                and value.device.type == "cpu"
                and not value.is_quantized
            )
            if not plain or value.untyped_storage().nbytes() < value.numel() * value.element_size():
                raise ValueError("it holds a tensor that is not there in full")
