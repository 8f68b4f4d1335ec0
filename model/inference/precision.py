"""The precisions that an encoder computes in, and how a fingerprint names them. Imports nothing
heavy: the command line offers them before torch is loaded."""

from typing import Literal

EffectivePrecision = Literal["float32", "bfloat16", "int8"]
Precision = Literal["auto"] | EffectivePrecision


def effective_precision(precision: Precision, device: str) -> EffectivePrecision:
    """`auto` is bfloat16 on CUDA and float32 elsewhere; a function of the kind of device, so that
    all workers agree.
    """
    if precision == "auto":
        return "bfloat16" if device == "cuda" else "float32"
    return precision


def describe_preprocessing(
    preprocessing: str, precision: EffectivePrecision, calibration: str | None = None
) -> str:
    """The words of a fingerprint for the preprocessing, and for the precision where it changes the
    embeddings.

    float32 adds nothing: plain, folded and compiled embeddings are the same up to rounding, and may
    share a table. For int8 `calibration` names the images it was calibrated by
    (`calibration_digest`); ValueError without.
    """
    if precision == "int8":
        if not calibration:
            raise ValueError(
                "int8 without its calibration; expected the digest of the images; see "
                "calibration_digest"
            )
        return f"{preprocessing}, int8 calibrated by {calibration}"
    return preprocessing if precision == "float32" else f"{preprocessing}, {precision}"
