"""The backbone in 8-bit integers, for CPUs that multiply them fast: torchao's post-training
quantisation for x86.

In: an encoder with fused BatchNorms, and images to calibrate by. Out: the same encoder with a
quantised backbone, to be compiled: uncompiled it computes the same slower than float32. Rings and
refinement stay in float32: they are a thousandth of the products.
"""

import hashlib
from collections.abc import Callable
from importlib import import_module

import torch
from torch import Tensor

from model.inference.torchao_logs import filter_torchao_logs
from model.pvda import FeatureEncoder

QUANTIZE_MODULE = "torchao.quantization.pt2e.quantize_pt2e"
QUANTIZER_MODULE = "torchao.quantization.pt2e.quantizer.x86_inductor_quantizer"
"Imported on use: torchao is optional, and its import takes seconds."
CALIBRATION_BATCH = 8
"Images at a time, independent of embedding's batch size: the ranges must not depend on that."
INT8_INSTRUCTIONS = ("avx512_vnni", "avx_vnni", "amx_int8")
"Instruction sets that multiply 8-bit integers, by torch's names; one of them suffices."


class PrecisionError(ValueError):
    """A precision is not available here. The message has what was found, what was expected and
    what to do.
    """


def require_int8(device: str) -> None:
    """Raise PrecisionError where int8 would not be faster than float32, or torchao is not
    installed.
    """
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
        with filter_torchao_logs():
            import_module(QUANTIZER_MODULE)
    except ImportError as error:
        raise PrecisionError(
            f"int8 needs torchao, which cannot be imported here ({error}); pip install "
            "'pvda[int8]', or choose "
            "--precision float32"
        ) from error


def require_quantizable(encoder: FeatureEncoder) -> None:
    """Raise PrecisionError where int8 has not been measured on this kind of backbone."""
    if not encoder.backbone.quantizable:
        raise PrecisionError(
            f"int8 is for convolutions with BatchNorm and the backbone is "
            f"{type(encoder.backbone).__name__}; choose --precision float32"
        )


def quantise(encoder: FeatureEncoder, size: int, calibrate: Callable[[], None]) -> None:
    """Put a quantised backbone into a fused `encoder`, for images of `size` x `size` pixels.

    `calibrate` runs images through the encoder while observers record the ranges of its
    activations: per tensor, 8 bits unsigned, from histograms. Weights have a range per output
    channel, signed. It runs on one thread: sums in another order give other ranges in their last
    digit, and workers would round differently.
    """
    threads = torch.get_num_threads()
    with filter_torchao_logs(), torch.no_grad():
        pt2e, x86 = import_module(QUANTIZE_MODULE), import_module(QUANTIZER_MODULE)
        example_B3HW = torch.zeros(CALIBRATION_BATCH, 3, size, size).to(
            memory_format=torch.channels_last
        )
        quantizer = x86.X86InductorQuantizer().set_global(
            x86.get_default_x86_inductor_quantization_config()
        )
        any_batch = ({0: torch.export.Dim.AUTO},)
        exported = torch.export.export(
            encoder.backbone, (example_B3HW,), dynamic_shapes=any_batch
        ).module()
        watched = pt2e.prepare_pt2e(exported, quantizer)
        encoder.add_module("backbone", watched)
        torch.set_num_threads(1)
        try:
            calibrate()
        finally:
            torch.set_num_threads(threads)
        encoder.add_module("backbone", pt2e.convert_pt2e(watched))


def calibration_digest(images_B3HW: Tensor) -> str:
    """16 hexadecimal digits of a hash over the calibration images (B, 3, H, W), in their order."""
    shape = str(tuple(images_B3HW.shape)).encode()
    return hashlib.sha256(shape + images_B3HW.cpu().contiguous().numpy().tobytes()).hexdigest()[:16]
