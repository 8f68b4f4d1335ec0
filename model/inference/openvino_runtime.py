"""An encoder run by OpenVINO, whose kernels for CPUs are faster than torch's.

In: a module of images as bytes (B, 3, H, W), and a batch of such images. Out: a callable for
batches of any number of images of that size, in float32, bfloat16 or 8-bit integers. No C++
compiler is needed, and a second suffices where torch.compile takes half a minute. An image's
embedding has the same bits in any batch.
"""

import warnings
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model.inference.compile import EmbedBatch, NotCompiled
from model.inference.int8 import quantise
from model.inference.precision import EffectivePrecision

PRECISIONS: dict[EffectivePrecision, str] = {"float32": "f32", "bfloat16": "bf16", "int8": "bf16"}
"""OpenVINO's name of a precision; with int8, of that of what is not quantised. Where a CPU does not
multiply bfloat16 it computes in float32."""
SETTINGS = {
    "PERFORMANCE_HINT": "LATENCY",  # one batch at a time, on all threads
    "ENABLE_CPU_PINNING": False,  # other processes and decoding threads share the cores
}


def compile_openvino(
    module: nn.Module,
    images_B3HW: Tensor,
    precision: EffectivePrecision = "float32",
    calibration_B3HW: Tensor | None = None,
) -> EmbedBatch:
    """`module`, which is on the CPU and in float32, for images of this size, on as many threads as
    torch's now. int8 is calibrated by `calibration_B3HW`.

    Raises NotCompiled: OpenVINO is not installed, or does not know one of the module's operations.
    """
    try:
        graph = _convert(_trace(module, images_B3HW[:2]), images_B3HW[:2])
        if calibration_B3HW is not None:
            graph = quantise(graph, calibration_B3HW)
        run = _compile(graph, PRECISIONS[precision])
        run(images_B3HW)
    except Exception as error:  # torch's tracer, the conversion and the compilation have many kinds
        lines = str(error).strip().splitlines()
        raise NotCompiled(
            f"{type(error).__name__}: {lines[0] if lines else 'no message'}"
        ) from error
    return run


def _trace(module: nn.Module, images_B3HW: Tensor) -> torch.jit.ScriptModule:
    with warnings.catch_warnings(), torch.no_grad():
        # Sizes of images become constants, as they may.
        tracers: type[Warning] = torch.jit.TracerWarning  # type: ignore[attr-defined]
        warnings.filterwarnings("ignore", category=tracers)
        warnings.filterwarnings("ignore", "`torch.jit", DeprecationWarning)
        traced: torch.jit.ScriptModule = torch.jit.trace(  # type: ignore[no-untyped-call]
            module, images_B3HW, check_trace=False
        )
    return traced


def _convert(traced: torch.jit.ScriptModule, images_B3HW: Tensor) -> Any:
    """The module as OpenVINO's graph, for any number of images."""
    # Here: whoever embeds a handful of images need not load it. Not by openvino.convert_model,
    # which sends statistics of its use over the network.
    from openvino.frontend import FrontEndManager
    from openvino.frontend.pytorch.ts_decoder import TorchScriptPythonDecoder

    decoder = TorchScriptPythonDecoder(traced, example_input=(images_B3HW,))  # kept until converted
    frontend = FrontEndManager().load_by_framework("pytorch")
    graph = frontend.convert(frontend.load(decoder))
    graph.reshape([-1, *images_B3HW.shape[1:]])
    return graph


def _compile(graph: Any, precision: str) -> EmbedBatch:
    import openvino

    settings = SETTINGS | {
        "INFERENCE_PRECISION_HINT": precision,
        "INFERENCE_NUM_THREADS": torch.get_num_threads(),
    }
    compiled = openvino.Core().compile_model(graph, "CPU", settings)

    def run(images_B3HW: Tensor) -> Tensor:
        [embeddings_BE] = compiled(images_B3HW.contiguous().numpy()).values()
        embeddings_BE = torch.from_numpy(embeddings_BE)
        # In new memory: the next batch is written to the same place. In bfloat16 their lengths are
        # a thousandth off 1.
        return embeddings_BE.clone() if precision == "f32" else F.normalize(embeddings_BE)

    return run
