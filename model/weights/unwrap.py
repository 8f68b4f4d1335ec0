"""What people save around a state dict -> its tensors, by the network's own names.

In: the value of a file of weights. Out: tensors by name, without the dict, the training loop and
the name prefixes around them. Prefixes that torch itself adds are always taken off; one that may be
the network's own (`model.`) only where a backbone's names ask for it, by `prefix_variants`.
"""

from collections import Counter
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from model.errors import CheckpointError

WRAPPERS = ("state_dict", "model_state_dict", "model_state", "model", "module", "net", "network")
"""Entries that hold the state dict in checkpoints of Lightning, timm, torchvision, DeepSpeed and
training scripts; beside them stand epochs, optimizers and settings."""
MAX_DEPTH = 3
"Wrappers within each other, as in `{model: {state_dict: ...}}`; likewise prefixes of names."
TORCH_PARTS = ("_orig_mod", "_fsdp_wrapped_module", "_checkpoint_wrapped_module")
"Parts of names that torch.compile, FSDP and activation checkpointing insert, at any place."
PREFIXES = ("module.", "model.")
"""Of DataParallel, DistributedDataParallel and averaged models; of the attribute that holds the
network in a LightningModule."""
AVERAGED_COUNT = "n_averaged"
"The count of steps that torch's AveragedModel stores beside `module.`."


def find_state_dict(value: Any, name: str) -> dict[str, Tensor]:
    """The state dict in the value of the file `name`, itself or below entries of WRAPPERS.

    Raises CheckpointError where there is none, or more than one.
    """
    found = list(_state_dicts(value, MAX_DEPTH))
    if len(found) > 1:
        raise CheckpointError(
            f"{name} holds {len(found)} state dicts ({', '.join(where for where, _ in found)}), "
            "expected one; save the one that is meant alone with torch.save"
        )
    if not found:
        raise CheckpointError(
            f"{name} has other values than tensors by name ({_describe(value)}); expected a state "
            "dict; save model.state_dict() alone"
        )
    return found[0][1]


def _state_dicts(
    value: Any, depth: int, where: str = ""
) -> Iterator[tuple[str, dict[str, Tensor]]]:
    """The outermost state dicts of a value, with the entries that lead to them."""
    if not isinstance(value, dict):
        return
    if all(isinstance(key, str) and isinstance(one, Tensor) for key, one in value.items()):
        yield where, value
    elif depth:
        for wrapper in WRAPPERS:
            inner = value.get(wrapper)
            if inner:  # an empty dict would pass for a state dict
                yield from _state_dicts(inner, depth - 1, f"{where}.{wrapper}".lstrip("."))


def _describe(value: Any) -> str:
    if not isinstance(value, dict):
        return f"a {type(value).__name__}"
    named = [
        f"{key}: {type(one).__name__}"
        for key, one in list(value.items())[:1000]
        if not isinstance(one, Tensor)
    ]
    return ", ".join(one[:60] for one in named[:3]) + (", ..." if len(named) > 3 else "")


def strip_torch_names(state: dict[str, Tensor], name: str) -> dict[str, Tensor]:
    """The state dict by the names that it has without torch.compile, FSDP and DataParallel.

    Raises CheckpointError where two tensors would have one name.
    """
    plain = {key: ".".join(_network_parts(key)) for key in state}
    if clash := next((key for key, count in Counter(plain.values()).items() if count > 1), None):
        both = " and ".join(key for key in state if plain[key] == clash)
        raise CheckpointError(
            f"{name} holds {clash} twice, as {both}, expected one network; save "
            "model.state_dict() of the one that is meant"
        )
    stripped = {plain[key]: tensor for key, tensor in state.items()}
    if AVERAGED_COUNT in stripped and all(
        key.startswith("module.") or key == AVERAGED_COUNT for key in stripped
    ):
        del stripped[AVERAGED_COUNT]
    for _ in range(MAX_DEPTH):
        stripped = _without_prefix(stripped, "module.") or stripped
    return stripped


def _network_parts(key: str) -> list[str]:
    return [part for part in key.split(".") if part not in TORCH_PARTS]


def prefix_variants(state: dict[str, Tensor]) -> Iterator[dict[str, Tensor]]:
    """The state dict as it is, then without one after another of PREFIXES that all names share."""
    yield state
    for _ in range(MAX_DEPTH):
        inner = (_without_prefix(state, prefix) for prefix in PREFIXES)
        stripped = next((one for one in inner if one), None)
        if stripped is None:
            return
        state = stripped
        yield state


def _without_prefix(state: dict[str, Tensor], prefix: str) -> dict[str, Tensor] | None:
    """None where not all names begin with the prefix, or one is nothing else."""
    if not all(key.startswith(prefix) and key != prefix for key in state):
        return None
    return {key.removeprefix(prefix): tensor for key, tensor in state.items()}


def check_finite(state: dict[str, Tensor], name: str) -> None:
    """Raise CheckpointError that names the first tensor with NaN or infinity.

    One such number spreads over all embeddings, and is noticed only at the first image otherwise.
    """
    wrong = {key: count for key, tensor in state.items() if (count := _not_finite(tensor))}
    if wrong:
        key, count = next(iter(wrong.items()))
        others = f" ({len(wrong) - 1} more tensors likewise)" if len(wrong) > 1 else ""
        raise CheckpointError(
            f"{name}: {key} has {count} of {state[key].numel()} numbers that are NaN or "
            f"infinite{others}, expected finite weights; take the file from before its training "
            "diverged, or copy it again"
        )


def _not_finite(tensor: Tensor) -> int:
    if not (tensor.is_floating_point() or tensor.is_complex()):
        return 0
    if tensor.element_size() == 1:  # float8, for which torch has no isfinite
        tensor = tensor.float()
    return tensor.numel() - int(torch.isfinite(tensor).sum())
