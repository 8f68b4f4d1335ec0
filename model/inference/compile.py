"""An encoder compiled with its weights frozen into it, by torch.compile.

In: a module of images as bytes (B, 3, H, W), and one batch. Out: a callable for batches of exactly
that size.

Compiled C++ lies in TORCHINDUCTOR_CACHE_DIR, by default a folder in the system's temporary one, and
is found again by the next start. Tracing and planning are done anew at each start: torch's cache of
whole graphs leaves out any that holds weights packed for oneDNN.
"""

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch
import torch._inductor.config
from torch import Tensor, nn

EmbedBatch = Callable[[Tensor], Tensor]


class NotCompiled(RuntimeError):
    """What cannot be compiled here. The message is the first line of the reason."""


def compile_frozen(module: nn.Module, images_B3HW: Tensor) -> EmbedBatch:
    """`module` compiled and tried on a batch, whose sizes are the only ones that it should be
    given.

    Raises NotCompiled: no C++ compiler, a driver too old, or whatever else torch reports.
    """
    # A whole graph or none: pieces of it in Python, or a limit of recompilations that is hit, would
    # be slow in silence.
    compiled = torch.compile(module, dynamic=False, fullgraph=True)

    def run(images_B3HW: Tensor) -> Tensor:
        # Freezing is looked up at each (re)compilation, not kept by the compiled function, and
        # gradients would switch it off.
        with torch.no_grad(), torch._inductor.config.patch(freezing=True):
            embeddings_BE: Tensor = compiled(images_B3HW)
        return embeddings_BE

    try:
        with ignore_deprecations():
            run(images_B3HW)
    except Exception as error:  # the compiler's own kinds, the C++ compiler's, the driver's
        lines = str(error).strip().splitlines()
        raise NotCompiled(
            f"{type(error).__name__}: {lines[0] if lines else 'without a word'}"
        ) from error
    return run


@contextmanager
def ignore_deprecations() -> Iterator[None]:
    """Without the deprecation that torch 2.13's own import of its compiler gives rise to. Anything
    else is told.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings(
            "ignore", "`torch.jit.script_method` is deprecated", DeprecationWarning
        )
        yield
