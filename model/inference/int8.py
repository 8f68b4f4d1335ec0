"""8-bit integers for CPUs that multiply them fast: post-training quantisation by NNCF of what
OpenVINO runs.

In: an encoder as OpenVINO's graph, and images to calibrate by. Out: the graph with its convolutions
quantised, to be compiled. Rings and refinement are not quantised: they are a thousandth of the
products.
"""

import contextlib
import hashlib
import io
import logging
import os
from importlib import import_module
from typing import Any

import torch
from torch import Tensor

from model.pvda import FeatureEncoder

CALIBRATION_BATCH = 8
"Images at a time, independent of embedding's batch size: the ranges must not depend on that."
INT8_INSTRUCTIONS = ("avx512_vnni", "avx_vnni", "amx_int8")
"Instruction sets that multiply 8-bit integers, by torch's names; one of them suffices."


class PrecisionError(ValueError):
    """A precision is not available here. The message has what was found, what was expected and
    what to do.
    """


def require_int8(device: str) -> None:
    """Raise PrecisionError where int8 would not be faster than float32, or without NNCF."""
    has = torch.cpu.get_capabilities()
    if device != "cpu":
        raise PrecisionError(
            f"int8 is for CPUs and the device is {device}; choose --precision bfloat16"
        )
    if not any(has.get(name) for name in INT8_INSTRUCTIONS):
        raise PrecisionError(
            f"this CPU ({has.get('architecture', 'unknown')}) has no "
            f"{', '.join(INT8_INSTRUCTIONS)}, so int8 would be slower than "
            "float32; choose --precision float32"
        )
    try:
        _import_nncf()
    except ImportError as error:
        raise PrecisionError(
            f"int8 needs NNCF, which cannot be imported here ({error}); pip install 'pvda[int8]', "
            "or choose --precision float32"
        ) from error


def require_quantizable(encoder: FeatureEncoder) -> None:
    """Raise PrecisionError where int8 has not been measured on this kind of backbone."""
    if not encoder.backbone.quantizable:
        raise PrecisionError(
            f"int8 is for convolutions with BatchNorm and the backbone is "
            f"{type(encoder.backbone).__name__}; choose --precision float32"
        )


def quantise(graph: Any, images_B3HW: Tensor) -> Any:
    """A graph with 8-bit convolutions, for images as bytes of the size of `images_B3HW`, which
    calibrate it.

    Activations have a range per tensor, from the least and greatest values of these images, weights
    one per output channel.
    """
    nncf = _import_nncf()
    batches = [part_B3HW.numpy() for part_B3HW in torch.split(images_B3HW, CALIBRATION_BATCH)]
    with contextlib.redirect_stdout(io.StringIO()):  # of progress bars, one for each step
        return nncf.quantize(
            graph,
            nncf.Dataset(batches),
            subset_size=len(batches),
            ignored_scope=nncf.IgnoredScope(types=["MatMul"], validate=False),
        )


def _import_nncf() -> Any:
    """NNCF: optional, and its import takes seconds. Raises ImportError."""
    # Elsewhere it sends statistics of its use over the network.
    os.environ.setdefault("NNCF_CI", "1")
    nncf = import_module("nncf")
    nncf.set_log_level(logging.ERROR)
    return nncf


def calibration_digest(images_B3HW: Tensor) -> str:
    """16 hexadecimal digits of a hash over the calibration images (B, 3, H, W), in their order."""
    shape = str(tuple(images_B3HW.shape)).encode()
    return hashlib.sha256(shape + images_B3HW.cpu().contiguous().numpy().tobytes()).hexdigest()[:16]
