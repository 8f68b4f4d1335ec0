"""A fast encoder computes what the plain one does, is checked for it, and says what it is.

Shapes: B images, E numbers of an embedding.
"""

import shutil
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from model.inference import optimise
from model.inference.compile import NotCompiled, compile_frozen
from model.inference.embed import MirroredEncoder, embed
from model.inference.int8 import PrecisionError, calibration_digest
from model.inference.optimise import MIN_COSINE, optimise_encoder
from model.inference.precision import describe_preprocessing, effective_precision
from model.pvda import FeatureEncoder

needs_compiler = pytest.mark.skipif(
    shutil.which("g++") is None, reason="torch.compile needs g++, which is not here"
)


def images(count: int, seed: int = 0) -> Tensor:
    """Bytes of soft noise, so that images differ in more than their grain."""
    coarse = torch.rand(count, 3, 4, 4, generator=torch.Generator().manual_seed(seed))
    fine = torch.rand(count, 3, 64, 64, generator=torch.Generator().manual_seed(seed + 1000))
    soft = torch.nn.functional.interpolate(coarse, (64, 64), mode="bicubic") * 200 + fine * 55
    return soft.clamp(0, 255).to(torch.uint8)


def fast(encoder: FeatureEncoder, **settings: Any) -> tuple[Any, list[str]]:
    """The fast encoder, with what it said."""
    said: list[str] = []
    defaults: dict[str, Any] = {"probe_B3HW": images(6), "batch_size": 4, "compiled": False}
    return optimise_encoder(encoder, log=said.append, **(defaults | settings)), said


def rolled() -> Callable[[MirroredEncoder, Tensor], Tensor]:
    """A forward pass that computes something else: the embedding's numbers move on by one place."""
    forward = MirroredEncoder.forward
    return lambda self, images_B3HW: forward(self, images_B3HW).roll(1, dims=1)


@pytest.mark.parametrize(("kind", "messages"), [("folded", 1), ("openvino", 2)])
@pytest.mark.parametrize("mirror", [True, False])
def test_fast_encoder_equals_plain(
    lively_encoder: FeatureEncoder, mirror: bool, kind: str, messages: int
) -> None:
    """With `mirror` one batch of both against two passes; 6 images are a batch and a half."""
    encoder, said = fast(lively_encoder, mirror=mirror, compiled=kind == "openvino")
    assert (encoder.kind, encoder.precision, len(said)) == (kind, "float32", messages)
    assert encoder.agreement > 1 - 1e-5
    assert said[-1] == (
        f"{kind} encoder in float32: cosine with the plain one 1.000000 in the mean, 1.000000 at "
        "worst, over 6 images"
    )
    with torch.inference_mode():  # whatever the caller is in
        found_BE = encoder(images(7, seed=5))
    assert found_BE.dtype == torch.float32
    torch.testing.assert_close(
        found_BE, embed(lively_encoder, images(7, seed=5), mirror), rtol=0, atol=1e-5
    )
    assert (embed(lively_encoder, images(7, seed=5), not mirror) - found_BE).abs().max() > 1e-3
    assert encoder(images(0)).shape == (0, 32)


def test_optimise_falls_back_to_plain_encoder(
    lively_encoder: FeatureEncoder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(MirroredEncoder, "forward", rolled())
    encoder, said = fast(lively_encoder, compiled=True)
    assert (encoder.kind, encoder.agreement) == ("plain", pytest.approx(1))
    assert said[0].startswith(
        "the folded encoder disagrees with the plain one (cosine with the plain one 0."
    )
    assert said[0].endswith("over 6 images); the plain one is used")
    torch.testing.assert_close(
        encoder(images(3)), embed(lively_encoder, images(3)), rtol=0, atol=1e-5
    )


def test_optimise_falls_back_from_wrong_compiled_encoders(
    lively_encoder: FeatureEncoder, monkeypatch: pytest.MonkeyPatch
) -> None:
    def wrong(*_: object) -> Callable[[Tensor], Tensor]:
        return lambda images_B3HW: torch.full((len(images_B3HW), 32), torch.nan)

    monkeypatch.setattr(optimise, "compile_openvino", wrong)
    monkeypatch.setattr(optimise, "compile_frozen", wrong)
    encoder, said = fast(lively_encoder, compiled=True)
    assert encoder.kind == "folded"
    for line, compiler in ((said[0], "OpenVINO"), (said[2], "torch")):
        assert line.startswith(
            f"the encoder compiled by {compiler} disagrees with the plain one (cosine with the "
            "plain one nan in the mean"
        )


@pytest.mark.parametrize(
    ("least", "error"), [(0.999, None), (1.1, "bfloat16 embeddings agree .* by a mean cosine of")]
)
def test_bfloat16_never_falls_back_to_float32(
    lively_encoder: FeatureEncoder, monkeypatch: pytest.MonkeyPatch, least: float, error: str | None
) -> None:
    monkeypatch.setitem(MIN_COSINE, "bfloat16", least)
    if error:
        with pytest.raises(PrecisionError, match=f"{error}.*; choose --precision float32"):
            fast(lively_encoder, precision="bfloat16")
        return
    encoder, _ = fast(lively_encoder, precision="bfloat16")
    assert (encoder.kind, encoder.precision) == ("folded", "bfloat16")
    assert 0.999 <= encoder.agreement < 1 - 1e-7
    monkeypatch.setattr(MirroredEncoder, "forward", rolled())
    plain, _ = fast(lively_encoder, precision="bfloat16")
    assert (plain.kind, plain.precision) == ("plain", "bfloat16")
    assert plain.agreement < 1 - 1e-7


def test_compile_is_skipped_where_it_does_not_pay(
    lively_encoder: FeatureEncoder, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise RuntimeError("no C++ compiler\nand a long story")

    monkeypatch.setattr(torch, "compile", lambda *_, **__: fail)
    monkeypatch.setattr(torch.jit, "trace", fail)
    for count in (None, 100):
        assert len(fast(lively_encoder, compiled="auto", images=count)[1]) == 1
    for compiled, count in (("auto", 10**9), (True, None)):
        encoder, said = fast(lively_encoder, compiled=compiled, images=count)
        assert encoder.kind == "folded"
        assert said[1].startswith("compiling the encoder for batches of 4")
        for line, compiler in ((said[0], "OpenVINO"), (said[2], "torch")):
            assert line == (
                f"the encoder cannot be compiled by {compiler} here (RuntimeError: no C++ "
                "compiler); continuing without"
            )


def test_openvino_pays_for_fewer_images_than_torch(
    lively_encoder: FeatureEncoder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(optimise, "_seconds", lambda *_: 0.1)
    assert fast(lively_encoder, compiled="auto", images=255)[0].kind == "folded"
    encoder, said = fast(lively_encoder, compiled="auto", images=256)
    assert (encoder.kind, encoder.precision) == ("openvino", "float32")
    assert [line.split(" ")[0] for line in said] == ["compiled", "openvino"]
    in_one_batch_BE = encoder(images(4))
    assert torch.equal(encoder(images(4)[2:3]), in_one_batch_BE[2:3])  # to the bit
    rounded, _ = fast(lively_encoder, compiled="auto", images=256, precision="bfloat16")
    assert (rounded.kind, rounded.precision) == ("openvino", "bfloat16")


@pytest.mark.slow
@needs_compiler
def test_compiled_encoder_equals_plain(
    lively_encoder: FeatureEncoder, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any) -> None:
        raise NotCompiled("an operation that it does not know")

    monkeypatch.setattr(optimise, "compile_openvino", fail)
    encoder, said = fast(lively_encoder, compiled=True)
    assert (encoder.kind, encoder.precision) == ("compiled", "float32")
    assert encoder.agreement > 1 - 1e-5
    assert [line.split(" ")[0] for line in said[1:]] == ["compiling", "compiled", "compiled"]
    with (
        torch.inference_mode(),
        torch._dynamo.config.patch(error_on_recompile=True),
    ):  # whatever the caller is in
        found_BE = encoder(images(7, seed=5))
        one_BE = encoder(images(1, seed=9))
    torch.testing.assert_close(
        found_BE, embed(lively_encoder, images(7, seed=5)), rtol=0, atol=1e-5
    )
    torch.testing.assert_close(one_BE, embed(lively_encoder, images(1, seed=9)), rtol=0, atol=1e-5)


@pytest.mark.slow
def test_compile_without_compiler_gives_one_reason() -> None:
    module = torch.nn.Softmax(dim=1)
    with (
        torch._inductor.config.patch(
            {"cpp.cxx": ("/there/is/none",), "force_disable_caches": True}
        ),
        pytest.raises(NotCompiled, match=r"^[^\n]+$"),
    ):
        compile_frozen(module, torch.rand(2, 3, 8, 8))


def test_precision_changes_the_fingerprint() -> None:
    one, other = calibration_digest(images(2)), calibration_digest(images(2, seed=1))
    texts = [
        describe_preprocessing("resized", "float32"),
        describe_preprocessing("resized", "bfloat16"),
    ]
    texts += [describe_preprocessing("resized", "int8", digest) for digest in (one, other)]
    assert len(set(texts)) == 4
    assert texts[0] == "resized"  # tables made before there was a choice stay what they are
    assert one == calibration_digest(images(2).to(memory_format=torch.channels_last))
    with pytest.raises(ValueError, match="int8 without its calibration"):
        describe_preprocessing("resized", "int8")


def test_precision_auto_depends_on_device_only() -> None:
    assert [effective_precision("auto", device) for device in ("cpu", "cuda")] == [
        "float32",
        "bfloat16",
    ]
    assert effective_precision("float32", "cuda") == "float32"
