"""An encoder compiled with its weights frozen into it, by torch.compile.

In: a module of images as bytes (B, 3, H, W), and one batch. Out: a callable for batches of exactly
that size.

Compiled C++ is cached in TORCHINDUCTOR_CACHE_DIR, by default a folder in the system's temporary
one, and reused by the next start. Tracing and planning are repeated at each start: torch's cache of
entire graphs excludes those with weights packed for oneDNN.
"""

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from torch import Tensor, nn

EmbedBatch = Callable[[Tensor], Tensor]


class NotCompiled(RuntimeError):
    """A module cannot be compiled here. The message is the first line of the reason."""


def compile_frozen(module: nn.Module, images_B3HW: Tensor) -> EmbedBatch:
    """`module` compiled and tried on a batch; call it with batches of that size only.

    Raises NotCompiled: no C++ compiler, a driver too old, or another of torch's errors.
    """
    # Here: its import takes two seconds, which an encoder that is not compiled need not spend.
    import torch._inductor.config

    # One full graph or an error: graph breaks, or the limit of recompilations, would make it slow
    # without a message.
    compiled = torch.compile(module, dynamic=False, fullgraph=True)

    def run(images_B3HW: Tensor) -> Tensor:
        # Freezing is read at each (re)compilation, not stored in the compiled function, and
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
            f"{type(error).__name__}: {lines[0] if lines else 'no message'}"
        ) from error
    return run


@contextmanager
def ignore_deprecations() -> Iterator[None]:
    """Ignore the deprecation that torch 2.13 raises when it imports its own compiler; show all
    other warnings.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings(
            "ignore", "`torch.jit.script_method` is deprecated", DeprecationWarning
        )
        yield
