"""Networks laid out without their weights' numbers and memory.

In: code that builds networks. Out: the same networks, on torch's meta device.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

DRAWS = (Tensor.normal_, nn.init.normal_, nn.init.kaiming_normal_)
"Of a meta tensor they change nothing, but the first of them imports torch's compiler: 2 s."


class _NothingDrawn(TorchFunctionMode):
    def __torch_function__(
        self,
        function: Callable[..., Any],
        types: Any,
        args: tuple[Any, ...] = (),
        kwargs: dict[str, Any] | None = None,
    ) -> Any:
        given = kwargs or {}
        if function in DRAWS:
            return args[0] if args else given["tensor"]
        return function(*args, **given)


@contextmanager
def shapes_alone() -> Iterator[None]:
    """A network of any size can be laid out, in milliseconds: shapes, and nothing to compute with.

    Not for weights that are loaded next: torch redraws normal deviates until they are in range.
    """
    with torch.device("meta"), _NothingDrawn():
        yield
