"""Making an encoder fast; each implementation is checked against the plain one before it is used.

In: an encoder in evaluation mode on its device, and a few images to check by. Out: a FastEncoder:
BatchNorm fused, channels last, image and mirror image in one batch, compiled where that pays; in
bfloat16 or 8-bit integers on request. Shapes: B images, E numbers of an embedding.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import torch
from torch import Tensor

from model.inference.compile import NotCompiled, compile_frozen
from model.inference.embed import CompiledKind, EncoderKind, FastEncoder, MirroredEncoder, embed
from model.inference.fuse_batchnorm import fuse_batchnorm
from model.inference.fuse_padding import fuse_padding
from model.inference.int8 import PrecisionError, require_int8, require_quantizable
from model.inference.openvino_runtime import compile_openvino
from model.inference.precision import EffectivePrecision, Precision, effective_precision
from model.pvda import FeatureEncoder

MIN_COSINE: dict[EffectivePrecision, float] = {"float32": 0.9999, "bfloat16": 0.99, "int8": 0.99}
"""Required cosine between the fast and the plain embedding of a probe image:
`FastEncoder.judged_agreement`."""
COMPILE_BREAK_EVEN_S = 120.0
"""Seconds that the folded encoder would need for all images. Compiling ResNet-50 for 256 px took
torch 13 to 25 s on two busy cores and saved a quarter of each image's time, so from two minutes on
it has paid; slower machines compile slower, too."""
OPENVINO_PAYS_FROM = 256
"""Images: it takes a second or two and saves half of 6 to 200 ms. By their number and not by their
time, so that the same images have the same bits each time."""
Log = Callable[[str], None]


def optimise_encoder(
    encoder: FeatureEncoder,
    *,
    probe_B3HW: Tensor,
    batch_size: int,
    precision: Precision = "auto",
    mirror: bool = True,
    compiled: bool | Literal["auto"] = "auto",
    images: int | None = None,
    calibration_B3HW: Tensor | None = None,
    log: Log = print,
) -> FastEncoder:
    """The fastest encoder that computes what `embed` does with `encoder`, which is in evaluation
    mode on its device.

    It is checked on `probe_B3HW`, a few images as bytes: where it disagrees (MIN_COSINE) `log` gets
    a message, and a plainer one of the same precision is used. `images` is the number to embed:
    with `compiled="auto"` the encoder is compiled where that pays, and an unknown number counts as
    small. Set torch's threads before: it is compiled for their number. int8 is calibrated by
    `calibration_B3HW`, 64 images or more, none of which should be a probe.

    Raises PrecisionError where `precision` is not available or agrees too little. The fingerprint
    names the precision in effect, so nothing falls back to float32 here.
    """
    device = encoder.mean_31.device
    wanted = effective_precision(precision, device.type)
    if wanted == "int8":
        require_quantizable(encoder)
        require_int8(device.type)
    check = _AgreementCheck(
        probe_B3HW=probe_B3HW,
        expected_BE=torch.cat(
            [
                embed(encoder, part.to(device), mirror)
                for part in torch.split(probe_B3HW, batch_size)
            ]
        ),
        precision=wanted,
        batch_size=batch_size,
        device=device,
    )
    fused = fuse_batchnorm(encoder)
    if device.type == "cpu":  # measured there; cuDNN may prefer the narrower kernels
        fuse_padding(fused, probe_B3HW.shape[2])
    module = MirroredEncoder(fused, mirror, wanted == "bfloat16")
    module.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    if wanted == "int8":
        return _int8(module, check, calibration_B3HW, log)
    fast = check.measure("folded", module)
    if not _agrees(fast):
        log(
            f"the folded encoder disagrees with the plain one ({check.describe(fast)}); "
            "the plain one is used"
        )
        fast = check.measure("plain", partial(_embed_plain, encoder, mirror, wanted == "bfloat16"))
        if wanted != "float32" and not _agrees(fast):
            raise PrecisionError(
                f"{wanted} embeddings agree with the float32 ones by a mean cosine of "
                f"{fast.mean_agreement:.4f}, expected at least "
                f"{MIN_COSINE[wanted]}; choose --precision float32"
            )
    elif compiled:
        count = math.inf if compiled is True else images or 0
        fast = _compile_if_it_pays(count, module, check, fast, log) or fast
    log(f"{fast.kind} encoder in {wanted}: {check.describe(fast)}")
    return fast


def _agrees(fast: FastEncoder) -> bool:
    """Whether it agrees with the plain encoder as its precision has to; NaN agrees with nothing."""
    return fast.judged_agreement >= MIN_COSINE[fast.precision]


@dataclass(frozen=True, kw_only=True)
class _AgreementCheck:
    """The check of a candidate against the plain encoder."""

    probe_B3HW: Tensor
    expected_BE: Tensor
    "The plain encoder's embeddings of these, in float32."
    precision: EffectivePrecision
    batch_size: int
    device: torch.device

    def measure(self, kind: EncoderKind, run: Callable[[Tensor], Tensor]) -> FastEncoder:
        """The candidate with its agreement."""
        fast = FastEncoder(
            kind=kind,
            precision=self.precision,
            batch_size=self.batch_size,
            device=self.device,
            run=run,
        )
        cosine_B = (fast(self.probe_B3HW).double() * self.expected_BE.double()).sum(1)
        return replace(fast, agreement=float(cosine_B.min()), mean_agreement=float(cosine_B.mean()))

    def describe(self, fast: FastEncoder) -> str:
        count = len(self.probe_B3HW)
        mean, worst = f"{fast.mean_agreement:.6f} in the mean", f"{fast.agreement:.6f} at worst"
        return f"cosine with the plain one {mean}, {worst}, over {count} images"

    def batch(self) -> Tensor:
        """A black batch, to compile for."""
        shape = (self.batch_size, *self.probe_B3HW.shape[1:])
        black_B3HW = torch.zeros(shape, dtype=torch.uint8, device=self.device)
        return black_B3HW.to(memory_format=torch.channels_last)


def _compile_if_it_pays(
    images: float, module: MirroredEncoder, check: _AgreementCheck, folded: FastEncoder, log: Log
) -> FastEncoder | None:
    """`module` compiled for so many images by the first compiler that pays and is able to."""
    if check.device.type == "cpu" and images >= OPENVINO_PAYS_FROM:
        fast = _compile("openvino", module, check, log)
        if fast is not None:
            return fast
    if images and _seconds(folded, check.probe_B3HW) * images >= COMPILE_BREAK_EVEN_S:
        return _compile("compiled", module, check, log)
    return None


def _compile(
    kind: CompiledKind, module: MirroredEncoder, check: _AgreementCheck, log: Log
) -> FastEncoder | None:
    """`module` compiled; None with the reason logged where it cannot be, or disagrees."""
    if kind == "compiled":
        log(
            f"compiling the encoder for batches of {check.batch_size}: this takes a while, less "
            "where it was done before"
        )
    start = time.perf_counter()
    by = "OpenVINO" if kind == "openvino" else "torch"
    try:
        if kind == "openvino":
            in_float32 = MirroredEncoder(module.encoder, module.mirror)
            run = compile_openvino(in_float32, check.batch(), check.precision)
        else:
            run = compile_frozen(module, check.batch())
        fast = check.measure(kind, run)
    except NotCompiled as error:
        log(f"the encoder cannot be compiled by {by} here ({error}); continuing without")
        return None
    if not _agrees(fast):
        log(
            f"the encoder compiled by {by} disagrees with the plain one "
            f"({check.describe(fast)}); continuing without"
        )
        return None
    log(f"compiled by {by} in {time.perf_counter() - start:.0f} s")
    return fast


def _int8(
    module: MirroredEncoder, check: _AgreementCheck, calibration_B3HW: Tensor | None, log: Log
) -> FastEncoder:
    """`module` quantised and run by OpenVINO. Raises PrecisionError."""
    if calibration_B3HW is None or not len(calibration_B3HW):
        raise PrecisionError(
            "int8 without images to calibrate by; expected 64 or more of the gallery; give some"
        )
    log(f"calibrating int8 on {len(calibration_B3HW)} images")
    start = time.perf_counter()
    try:
        run = compile_openvino(module, check.batch(), "int8", calibration_B3HW)
    except NotCompiled as error:
        raise PrecisionError(
            f"int8 is run by OpenVINO, which failed ({error}); choose --precision float32"
        ) from error
    fast = check.measure("openvino", run)
    log(f"int8 encoder, made in {time.perf_counter() - start:.0f} s: {check.describe(fast)}")
    if not _agrees(fast):
        raise PrecisionError(
            "int8 embeddings agree with the float32 ones by a mean cosine of "
            f"{fast.mean_agreement:.4f}, expected at least "
            f"{MIN_COSINE['int8']}; calibrate by more images that are like the gallery's, or "
            "choose --precision float32"
        )
    return fast


def _seconds(fast: FastEncoder, probe_B3HW: Tensor) -> float:
    """That `fast` needs for an image. The check has warmed it up."""
    start = time.perf_counter()
    fast(probe_B3HW).cpu()  # waits for the device
    return (time.perf_counter() - start) / len(probe_B3HW)


def _embed_plain(
    encoder: FeatureEncoder, mirror: bool, bfloat16: bool, images_B3HW: Tensor
) -> Tensor:
    with torch.autocast(images_B3HW.device.type, torch.bfloat16, enabled=bfloat16):
        return embed(encoder, images_B3HW, mirror)
