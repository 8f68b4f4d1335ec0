"""8-bit integers: they agree with float32 on other images, are calibrated alike wherever they are,
and are refused where they cannot be had.
"""

import sys
from typing import Any

import numpy as np
import pytest
import torch

from model.inference import int8, optimise
from model.inference.embed import embed
from model.inference.int8 import INT8_INSTRUCTIONS, PrecisionError, require_int8
from model.pvda import FeatureEncoder
from tests.model.test_inference import fast, images


@pytest.mark.slow
def test_int8_agrees_on_other_images(lively_encoder: FeatureEncoder) -> None:
    pytest.importorskip("nncf", reason="int8 is optional: pip install 'pvda[int8]'")
    if not any(torch.cpu.get_capabilities().get(name) for name in INT8_INSTRUCTIONS):
        pytest.skip("this CPU has no VNNI and no AMX")
    calibration_B3HW = images(9, seed=50)
    encoder, said = fast(lively_encoder, precision="int8", calibration_B3HW=calibration_B3HW)
    assert (encoder.kind, encoder.precision) == ("openvino", "int8")
    assert 0.99 <= encoder.mean_agreement < 1 - 1e-7
    assert said[0] == "calibrating int8 on 9 images"
    assert said[1].startswith("int8 encoder, made in ")
    found_BE = encoder(images(5, seed=5))
    torch.testing.assert_close(found_BE.norm(dim=1), torch.ones(5))
    assert (found_BE * embed(lively_encoder, images(5, seed=5))).sum(1).mean() > 0.99


@pytest.mark.slow
def test_int8_ranges_do_not_depend_on_threads(
    lively_encoder: FeatureEncoder, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two workers that round differently would differ from each other as much as from float32.
    Quantised on any CPU, whatever its products are.
    """
    pytest.importorskip("nncf", reason="int8 is optional: pip install 'pvda[int8]'")
    monkeypatch.setattr(optimise, "require_int8", lambda device: None)
    monkeypatch.setattr(optimise, "_agrees", lambda fast: True)
    threads, graphs = torch.get_num_threads(), list[Any]()

    def kept(*given: Any) -> Any:
        graphs.append(int8.quantise(*given))
        return graphs[-1]

    monkeypatch.setattr("model.inference.openvino_runtime.quantise", kept)
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            fast(lively_encoder, precision="int8", calibration_B3HW=images(6))
    finally:
        torch.set_num_threads(threads)
    one, other = (
        [node.data for node in graph.get_ops() if node.get_type_name() == "Constant"]
        for graph in graphs
    )
    kinds = [node.get_type_name() for node in graphs[0].get_ops()]
    assert kinds.count("FakeQuantize") >= kinds.count("Convolution") > 0
    assert all(map(np.array_equal, one, other)), "ranges and weights are constants of the graph"


def test_int8_unavailable_is_rejected_with_the_remedy(
    lively_encoder: FeatureEncoder, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(
        PrecisionError, match="int8 is for CPUs and the device is cuda; choose --precision bfloat16"
    ):
        require_int8("cuda")
    monkeypatch.setattr(
        torch.cpu, "get_capabilities", lambda: {"architecture": "x86_64", "avx512_vnni": True}
    )
    monkeypatch.setitem(sys.modules, "nncf", None)
    with pytest.raises(
        PrecisionError, match=r"int8 needs NNCF, .*; pip install 'pvda\[int8\]', or choose"
    ):
        require_int8("cpu")
    monkeypatch.setattr(
        torch.cpu, "get_capabilities", lambda: {"architecture": "x86_64", "avx2": True}
    )
    with pytest.raises(
        PrecisionError,
        match=r"this CPU \(x86_64\) has no avx512_vnni.*; choose --precision float32",
    ):
        fast(lively_encoder, precision="int8", calibration_B3HW=images(4))
    monkeypatch.setattr(optimise, "require_int8", lambda device: None)
    with pytest.raises(
        PrecisionError, match="int8 without images to calibrate by; expected 64 or more"
    ):
        fast(lively_encoder, precision="int8")


def test_int8_with_low_agreement_is_rejected(
    lively_encoder: FeatureEncoder, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither a slow table nor a wrong one is what was asked for."""
    monkeypatch.setattr(optimise, "require_int8", lambda device: None)
    monkeypatch.setattr(
        optimise, "compile_openvino", lambda module, *_: lambda x: module(x).roll(1, dims=1)
    )
    with pytest.raises(
        PrecisionError,
        match=r"by a mean cosine of -?0\.\d+, expected at least 0.99; calibrate by more",
    ):
        fast(lively_encoder, precision="int8", calibration_B3HW=images(4))
