"""Public weights of networks of `transformers`: a folder, or a name on the Hugging Face hub.

In: such a network, and FOLDER (as `save_pretrained` writes it) or hf:OWNER/NAME. Out: its state
dict. The library's own `from_pretrained` reads it, so that its renamings of older weights apply;
safetensors only, and none of the code that a folder may hold.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from model.backbones import HUB_PREFIX
from model.errors import CheckpointError
from model.weights.unwrap import check_finite

HUB_NAME = re.compile(r"[\w.-]+/[\w.-]+")
"OWNER/NAME of a model on the hub."


def comes_as_folder(source: str) -> bool:
    """Whether weights of that path or name are a folder or the hub's, and not one file."""
    return source.startswith(HUB_PREFIX) or Path(source).is_dir()


def read_pretrained(
    network: nn.Module,
    source: str,
    settings: Sequence[str],
    options: Mapping[str, Any],
    example: str,
) -> dict[str, Tensor]:
    """The state dict for `network`, a model of transformers built with `options`, from `source`.

    `settings` name those of its config that tell the size, and `example` is a source that fits it.
    Raises CheckpointError where the source cannot be read, or is of another network.
    """
    remedy = f"give weights like {example}, or choose another --backbone"
    where = _locate(source, remedy)
    kind: Any = type(network)
    expected: Any = network.config
    safe = {"trust_remote_code": False, "local_files_only": where == source}
    with _quiet():
        try:
            found, _ = expected.get_config_dict(where, local_files_only=where == source)
        except (OSError, ValueError) as error:
            raise _unreadable(source, error, remedy) from error
        _require_same_network(source, found, expected, settings, remedy)
        try:
            given, report = kind.from_pretrained(
                where, config=expected, use_safetensors=True, dtype=torch.float32,
                output_loading_info=True, **options, **safe,
            )  # fmt: skip
        # a damaged file raises safetensors' own kind, tensors of other shapes a RuntimeError
        except Exception as error:
            raise _unreadable(source, error, remedy) from error
    if missing := sorted(report["missing_keys"]):
        raise CheckpointError(
            f"{source} lacks {len(missing)} tensors ({missing[0]} first), expected all of this "
            f"backbone; {remedy}"
        )
    state: dict[str, Tensor] = given.state_dict()
    check_finite(state, source)
    return state


def _locate(source: str, remedy: str) -> str:
    """The folder, or the hub's name, for `from_pretrained`. Raises CheckpointError."""
    if source.startswith(HUB_PREFIX):
        name = source.removeprefix(HUB_PREFIX)
        if not HUB_NAME.fullmatch(name):
            raise CheckpointError(
                f"{source} is no name on the hub, expected hf:OWNER/NAME; {remedy}"
            )
        return name
    folder = Path(source)
    if not (folder / "config.json").is_file() or not list(folder.glob("*.safetensors")):
        names = ", ".join(sorted(path.name for path in folder.iterdir())[:5]) or "nothing"
        raise CheckpointError(
            f"{source} holds {names}, expected config.json and model.safetensors (pickles such as "
            "pytorch_model.bin can run code and are not read); write it with save_pretrained of "
            "transformers"
        )
    return source


def _require_same_network(
    source: str, found: dict[str, Any], expected: Any, settings: Sequence[str], remedy: str
) -> None:
    """Raise CheckpointError where the config of `source` is of another network."""
    if found.get("model_type") != expected.model_type:
        raise CheckpointError(
            f"{source} holds a network of type {found.get('model_type')}, expected "
            f"{expected.model_type}; {remedy}"
        )
    default = type(expected)()
    for key in settings:
        value, wanted = found.get(key, getattr(default, key)), getattr(expected, key)
        if value != wanted:
            raise CheckpointError(f"{source} has {key} {value}, expected {wanted}; {remedy}")


def _unreadable(source: str, error: Exception, remedy: str) -> CheckpointError:
    lines = str(error).strip().splitlines()
    reason = f"{type(error).__name__}: {lines[0].strip() if lines else 'no message'}"
    if source.startswith(HUB_PREFIX):
        return CheckpointError(
            f"{source} cannot be read from the hub ({reason}), expected its config.json and "
            "model.safetensors; check the name and the network, or download it elsewhere and give "
            "the folder"
        )
    return CheckpointError(
        f"{source} cannot be read ({reason}), expected a folder of save_pretrained; copy it again, "
        f"or {remedy}"
    )


@contextmanager
def _quiet() -> Iterator[None]:
    """No progress bars, and no report of a classifier that is left out."""
    logs = import_module("transformers.utils.logging")
    verbosity, bars = logs.get_verbosity(), logs.is_progress_bar_enabled()
    logs.set_verbosity_error()
    logs.disable_progress_bar()
    try:
        yield
    finally:
        logs.set_verbosity(verbosity)
        if bars:
            logs.enable_progress_bar()
