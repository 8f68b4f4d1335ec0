"""Networks laid out without drawing their weights, which takes most of the time.

In: code that builds networks. Out: the same networks: shapes alone, on torch's meta device, or with
zeros where the weights come from elsewhere.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

DRAWS = {"normal_", "uniform_", "kaiming_normal_", "kaiming_uniform_"}
"""What networks draw their weights by: methods of tensors, functions of torch.nn.init, and those
that transformers puts in their place. Zeros instead, for some draw until all are in a range."""


class _NothingDrawn(TorchFunctionMode):
    def __torch_function__(
        self,
        function: Callable[..., Any],
        types: Any,
        args: tuple[Any, ...] = (),
        kwargs: dict[str, Any] | None = None,
    ) -> Any:
        given = kwargs or {}
        if getattr(function, "__name__", "") not in DRAWS:
            return function(*args, **given)
        tensor: Tensor = args[0] if args else given["tensor"]
        if tensor.is_meta:  # nothing to change, and the first change imports torch's compiler: 2 s
            return tensor
        with torch.no_grad():
            return tensor.zero_()


@contextmanager
def shapes_alone() -> Iterator[None]:
    """A network of any size can be laid out, in milliseconds: shapes, nothing to compute with."""
    with torch.device("meta"), _NothingDrawn():
        yield


@contextmanager
def weights_follow() -> Iterator[None]:
    """A network is laid out whose weights are all loaded next: in a third of the time."""
    with _NothingDrawn():
        yield
