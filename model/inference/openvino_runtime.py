"""An encoder run by OpenVINO, whose kernels for CPUs are faster than torch's.

In: a module of images as bytes (B, 3, H, W), and a batch of such images. Out: a callable for
batches of any number of images of that size, in float32 or bfloat16. No C++ compiler is needed, and
a second suffices where torch.compile takes half a minute. An image's embedding has the same bits in
any batch.
"""

import warnings

import torch
from torch import Tensor, nn

from model.inference.compile import EmbedBatch, NotCompiled
from model.inference.precision import EffectivePrecision

PRECISIONS: dict[EffectivePrecision, str] = {"float32": "f32", "bfloat16": "bf16"}
"""That it is asked for, and OpenVINO's names of them. Where a CPU does not multiply bfloat16 it
computes in float32."""
SETTINGS = {
    "PERFORMANCE_HINT": "LATENCY",  # one batch at a time, on all threads
    "ENABLE_CPU_PINNING": False,  # other processes and decoding threads share the cores
}


def compile_openvino(
    module: nn.Module, images_B3HW: Tensor, precision: EffectivePrecision = "float32"
) -> EmbedBatch:
    """`module`, which is on the CPU and in float32, for images of this size, on as many threads as
    torch's now.

    Raises NotCompiled: OpenVINO is not installed, or does not know one of the module's operations.
    """
    few_B3HW = images_B3HW[:2]
    try:
        run = _compile(_trace(module, few_B3HW), few_B3HW, PRECISIONS[precision])
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


def _compile(traced: torch.jit.ScriptModule, images_B3HW: Tensor, precision: str) -> EmbedBatch:
    # Here: whoever embeds a handful of images need not load it. Not by openvino.convert_model,
    # which sends statistics of its use over the network.
    import openvino
    from openvino.frontend import FrontEndManager
    from openvino.frontend.pytorch.ts_decoder import TorchScriptPythonDecoder

    decoder = TorchScriptPythonDecoder(traced, example_input=(images_B3HW,))  # kept until converted
    frontend = FrontEndManager().load_by_framework("pytorch")
    graph = frontend.convert(frontend.load(decoder))
    graph.reshape([-1, *images_B3HW.shape[1:]])
    settings = SETTINGS | {
        "INFERENCE_PRECISION_HINT": precision,
        "INFERENCE_NUM_THREADS": torch.get_num_threads(),
    }
    compiled = openvino.Core().compile_model(graph, "CPU", settings)

    def run(images_B3HW: Tensor) -> Tensor:
        [embeddings_BE] = compiled(images_B3HW.contiguous().numpy()).values()
        return torch.from_numpy(embeddings_BE.copy())  # the next batch is written to the same place

    return run
