"""The weights in a checkpoint, whatever a training loop wrapped them in."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from gsmap.utils.errors import InputError

WRAPPERS = ("state_dict", "model_state_dict", "model_state", "model", "network", "net", "weights")
_DEEPEST = 3  # wrappers within one another
_OUTER = ("model.", "network.", "net.")  # before all keys, of modules that hold a model
# parts of keys that wrappers of modules leave; the first one, of parallel training, in front alone
_PARALLEL = "module."
_INNER = ("_orig_mod", "_fsdp_wrapped_module", "_checkpoint_wrapped_module")
_AVERAGED = "ema_"
_SHOWN = 8  # keys in a message
_MOST_REPEATED = 4  # times that the values of all weights may be more than those stored
_SPARE_BYTES = 1 << 26  # that may be repeated however few are stored


class UnfitError(InputError):
    """A checkpoint holds no weights that can be used; the message follows its name."""


@dataclass(frozen=True)
class Unwrapped:
    """Weights without what they were wrapped in.

    Attributes:
        state: The weights, by keys of the model.
        holder: The mapping that the weights or their wrapper lie in; None for a bare state dict.
        left_out: How many entries are not used, by what they are.
    """

    state: dict[str, Tensor]
    holder: Mapping[str, Any] | None
    left_out: dict[str, int] = field(default_factory=dict)


def unwrap(content: Any) -> Unwrapped:
    """Find the weights in what a checkpoint holds, and take the wrapping off their keys.

    They lie under the first of ``WRAPPERS`` that is there, to a depth of three; else they are the
    content itself; else the one entry that is a state dict. Off the keys come prefixes of parallel
    training, of compiled modules and of modules that hold the model. Averages beside the weights
    that they are of, counters and entries that are no tensors are left out.

    Args:
        content: What the file holds.

    Raises:
        UnfitError: If there are no weights, or two under one key; the message lists the keys.
    """
    found = _find(content, 0)
    if found is None:
        if not isinstance(content, Mapping):
            keys = f"is a {type(content).__name__}"
        else:
            names = [key for key in content if isinstance(key, str)]
            keys = f"has the keys {names[:_SHOWN]!r:.300}" if names else "has no key"
        raise UnfitError(
            f"holds no state dict of tensors: it {keys}, and weights lie in it as they are, or "
            f"under {', '.join(WRAPPERS)}: give a training checkpoint"
        )
    weights = {key: value for key, value in found.items() if isinstance(value, Tensor)}
    if not all(map(_is_plain, weights.values())):
        odd = next(key for key, value in weights.items() if not _is_plain(value))
        raise UnfitError(f"holds no state dict of plain tensors: {odd!r:.80} is another kind")
    _require_stored(weights.values())
    left_out = {"entries that are no tensors": len(found) - len(weights)}
    counters = {key for key, value in weights.items() if _is_counter(key, value)}
    if _is_dotted(weights):
        weights = {key: value for key, value in weights.items() if key not in counters}
        left_out["counters"] = len(counters)
    state = _plain_keys(weights)
    flat = {_AVERAGED + key.replace(".", "_") for key in state}
    averages = flat & state.keys()
    state = {key: value for key, value in state.items() if key not in averages}
    left_out["averages of weights (EMA)"] = len(averages)
    holder = None if found is content else content
    return Unwrapped(state, holder, {what: count for what, count in left_out.items() if count})


def _find(content: Any, depth: int) -> Mapping[str, Any] | None:
    """Return the state dict in nested wrappers, or None."""
    if not isinstance(content, Mapping) or depth > _DEEPEST:
        return None
    for name in WRAPPERS:
        if isinstance(content.get(name), Mapping) and (found := _find(content[name], depth + 1)):
            return found
    if _is_state(content):
        return content
    states = [value for value in content.values() if _is_state(value) and _is_dotted(value)]
    return states[0] if len(states) == 1 else None


def _is_state(value: Any) -> bool:
    """Whether a value maps texts to tensors, and maybe to other things that are no mappings."""
    if not isinstance(value, Mapping) or not all(isinstance(key, str) for key in value):
        return False
    has_mapping = any(isinstance(entry, Mapping) for entry in value.values())
    return not has_mapping and any(isinstance(entry, Tensor) for entry in value.values())


def _is_dotted(value: Mapping[str, Any]) -> bool:
    """Whether the keys are those of a model's parts."""
    return any("." in key for key in value)


def _is_counter(key: str, value: Tensor) -> bool:
    """Whether an entry is one number beside the parts of a model."""
    return "." not in key and not key.startswith(_AVERAGED) and value.numel() == 1


def _is_plain(value: Tensor) -> bool:
    """Whether a tensor has plain values that can be a weight's."""
    return value.layout is torch.strided and not (value.is_quantized or value.is_meta)


def _require_stored(weights: Iterable[Tensor]) -> None:
    """Refuse tensors that repeat few stored values until they fill all memory.

    Raises:
        UnfitError: If they do.
    """
    stored: dict[int, int] = {}
    total = 0
    for value in weights:
        storage = value.untyped_storage()
        stored[storage.data_ptr()] = storage.nbytes()
        total += value.numel() * value.element_size()
    if total > _MOST_REPEATED * sum(stored.values()) + _SPARE_BYTES:
        raise UnfitError(
            f"repeats {sum(stored.values())} bytes of weights until they are {total}: save it with "
            "its tensors cloned"
        )


def _plain_keys(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return weights by keys without the prefixes of wrappers."""
    names = {key: _without_parts(key) for key in weights}
    while prefix := next((p for p in _OUTER if all(n.startswith(p) for n in names.values())), None):
        if not names:
            break
        names = {key: _without_parts(name.removeprefix(prefix)) for key, name in names.items()}
    state: dict[str, Tensor] = {}
    for key, value in weights.items():
        if names[key] in state:
            raise UnfitError(
                f"holds two weights under {names[key]!r:.80}, with and without a prefix"
            )
        state[names[key]] = value
    return state


def _without_parts(key: str) -> str:
    """Return a key without the parts of wrappers of modules."""
    parts = [part for part in key.split(".") if part not in _INNER]
    name = ".".join(parts)
    while name.startswith(_PARALLEL):
        name = name.removeprefix(_PARALLEL)
    return name
