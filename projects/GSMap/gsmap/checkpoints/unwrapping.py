"""Extraction of the weights from the wrappers that training loops put around them."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from gsmap.utils.errors import InputError

# Keys under which training loops store the state dict, in the order of preference.
WRAPPERS = ("state_dict", "model_state_dict", "model_state", "model", "network", "net", "weights")
_DEEPEST = 3  # largest number of nested wrappers
_OUTER_PREFIXES = ("model.", "network.", "net.")  # each is removed if all keys start with it
_PARALLEL_PREFIX = "module."  # of parallel training; removed only at the start of a key
# Parts of keys, between dots, from compiled modules, sharded training and activation checkpoints.
_WRAPPER_PARTS = ("_orig_mod", "_fsdp_wrapped_module", "_checkpoint_wrapped_module")
_AVERAGED = "ema_"  # prefix of keys of exponential moving averages of weights
_MAX_KEYS_SHOWN = 8  # largest number of keys in a message
# Largest ratio of the bytes of all weights to the stored bytes. It exceeds 1, because weights that
# modules share are stored once.
_MOST_REPEATED = 4
_SPARE_BYTES = 1 << 26  # number of bytes (64 MiB) that may be repeated in addition


class UnfitError(InputError):
    """Error of a checkpoint without usable weights.

    The message begins with a verb, because the reader of the file puts the file's name before it.
    """


@dataclass(frozen=True)
class Unwrapped:
    """Weights without their wrappers.

    Attributes:
        state: Weights by the keys of the model.
        holder: Contents of the file, if the weights are only a part of them; None for a bare state
            dict.
        left_out: Number of unused entries, by a text that names their kind.
    """

    state: dict[str, Tensor]
    holder: Mapping[str, Any] | None
    left_out: dict[str, int] = field(default_factory=dict)


def unwrap(content: Any) -> Unwrapped:
    """Find the weights in the contents of a checkpoint, and remove wrappers from their keys.

    There are two kinds of wrappers: dictionaries that contain the state dict under one of their
    keys, and modules around the model or its submodules, which add parts to keys. The weights are
    under the first key of ``WRAPPERS`` that leads to a state dict. Up to three dictionaries may be
    nested around it. A dictionary without such a key is the state dict itself, if it has tensors
    and no nested dictionary. Otherwise its only entry that is a state dict with a dot in a key is
    taken.

    From the keys, the function removes the parts of parallel and sharded training, of compiled
    modules, of activation checkpoints, and of modules around the model. It leaves out entries
    that are no tensors, single numbers such as the epoch (counters), and moving averages of weights
    that are in the state dict, too.

    Args:
        content: Contents of the file.

    Raises:
        UnfitError: If there are no weights (the message lists the keys); if two weights have one
            key without their wrappers; if a tensor is sparse, quantized or without values; or if
            the tensors have far more bytes than the file stores, as expanded tensors do.
    """
    entries = _find_state(content, depth=0)
    if entries is None:
        raise UnfitError(_describe_contents(content))
    weights = _select_tensors(entries)
    _require_stored(weights.values())
    left_out: dict[str, int] = {}
    if len(weights) < len(entries):
        left_out["entries that are no tensors"] = len(entries) - len(weights)
    counters = _find_counters(weights)
    if counters:
        left_out["counters"] = len(counters)
    for key in counters:
        del weights[key]
    state = _unwrap_keys(weights)
    averages = _find_averages(state)
    if averages:
        left_out["averages of weights (EMA)"] = len(averages)
    for key in averages:
        del state[key]
    holder = None if entries is content else content
    left_out |= _count_other_states(content, entries)
    return Unwrapped(state=state, holder=holder, left_out=left_out)


def _select_tensors(entries: Mapping[str, Any]) -> dict[str, Tensor]:
    """Select the tensors of a state dict.

    Raises:
        UnfitError: If a tensor is sparse, quantized or without values.
    """
    tensors: dict[str, Tensor] = {}
    for key, value in entries.items():
        if not isinstance(value, Tensor):
            continue
        is_dense = value.layout is torch.strided
        if not is_dense or value.is_quantized or value.is_meta:
            raise UnfitError(f"holds no state dict of plain tensors: {key!r:.80} is another kind")
        tensors[key] = value
    return tensors


def _count_other_states(
    content: Mapping[Any, Any], entries: Mapping[str, Any], depth: int = 0
) -> dict[str, int]:
    """Count the weights in further state dicts than ``entries``, such as averages."""
    counts: dict[str, int] = {}
    for name, value in content.items():
        if value is entries or not isinstance(value, Mapping):
            continue
        if _is_state(value) and _has_dotted_key(value):
            counts[f"weights under {name!r:.80}"] = len(value)
        elif depth < _DEEPEST:
            for text, count in _count_other_states(value, entries, depth=depth + 1).items():
                counts[f"{text} of {name!r:.80}"] = count
    return counts


def _describe_contents(content: Any) -> str:
    """Message about contents without weights."""
    if not isinstance(content, Mapping):
        finding = f"is a {type(content).__name__}"
    else:
        names = [key for key in content if isinstance(key, str)]
        shown_names = names[:_MAX_KEYS_SHOWN]
        finding = f"has the keys {shown_names!r:.300}" if names else "has no key"
    return (
        f"holds no state dict of tensors: it {finding}, and weights must be its entries or "
        f"be under {', '.join(WRAPPERS)}: give a training checkpoint"
    )


def _find_state(content: Any, depth: int) -> Mapping[str, Any] | None:
    """Find the state dict in nested wrappers; None if there is none.

    Args:
        content: Contents of a file or of a wrapper.
        depth: Number of wrappers around ``content``.
    """
    if not isinstance(content, Mapping) or depth > _DEEPEST:
        return None
    for name in WRAPPERS:
        if isinstance(content.get(name), Mapping):  # if it leads to no state dict, try the next
            state = _find_state(content[name], depth=depth + 1)
            if state:
                return state
    if _is_state(content):
        return content
    # Last, state dicts under unknown keys. Here a dot in a key is required, because a dictionary of
    # tensors without dots in its keys may be something other than weights.
    states: list[Mapping[str, Any]] = []
    for value in content.values():
        if _is_state(value) and _has_dotted_key(value):
            states.append(value)
    return states[0] if len(states) == 1 else None


def _is_state(value: Any) -> bool:
    """Whether a value is a mapping with string keys alone, with tensors and no nested mappings."""
    if not isinstance(value, Mapping):
        return False
    has_tensor = False
    for key, entry in value.items():
        if not isinstance(key, str) or isinstance(entry, Mapping):
            return False
        has_tensor = has_tensor or isinstance(entry, Tensor)
    return has_tensor


def _has_dotted_key(state: Mapping[str, Any]) -> bool:
    """Whether any key contains a dot, as the keys of a model's submodules do."""
    return any("." in key for key in state)


def _find_counters(weights: Mapping[str, Tensor]) -> list[str]:
    """Keys of single numbers that belong to no submodule, such as the epoch.

    Keys of averages have no dot either, but belong to weights. If no key at all has a dot, the
    weights belong to one module without submodules, and a single number may be a weight.
    """
    if not _has_dotted_key(weights):
        return []
    counters = []
    for key, value in weights.items():
        is_average = key.startswith(_AVERAGED)
        if "." not in key and not is_average and value.numel() == 1:
            counters.append(key)
    return counters


def _find_averages(state: Mapping[str, Tensor]) -> set[str]:
    """Keys of moving averages of weights: the average of the weight ``a.b`` is ``ema_a_b``.

    An average without its weight counts as a weight.
    """
    averages: set[str] = set()
    for key in state:
        name_of_average = _AVERAGED + key.replace(".", "_")
        if name_of_average in state:
            averages.add(name_of_average)
    return averages


def _require_stored(weights: Iterable[Tensor]) -> None:
    """Refuse expanded tensors, which repeat few stored values and would fill the memory.

    Raises:
        UnfitError: If the tensors have many more bytes than their storages.
    """
    # Several tensors may be views of one storage, whose bytes count once. The key is its address.
    bytes_by_storage: dict[int, int] = {}
    total = 0  # number of bytes of all tensors, if each had a separate storage
    for value in weights:
        storage = value.untyped_storage()
        bytes_by_storage[storage.data_ptr()] = storage.nbytes()
        total += value.numel() * value.element_size()
    stored = sum(bytes_by_storage.values())
    if total > _MOST_REPEATED * stored + _SPARE_BYTES:
        raise UnfitError(
            f"repeats {stored} bytes of weights until they are {total}: save it with "
            "its tensors cloned"
        )


def _unwrap_keys(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Remove prefixes and parts of wrappers from the keys of weights.

    Raises:
        UnfitError: If two keys become equal.
    """
    names = _inner_names(weights, prefix="")
    prefix = _common_prefix(names)
    while prefix:  # modules around the model may be nested
        names = _inner_names(names, prefix)
        prefix = _common_prefix(names)
    state: dict[str, Tensor] = {}
    for name, value in zip(names, weights.values(), strict=True):
        if name in state:
            raise UnfitError(f"holds two weights under {name!r:.80}, with and without a prefix")
        state[name] = value
    return state


def _inner_names(names: Iterable[str], prefix: str) -> list[str]:
    """Names without a prefix, and without the parts that wrappers add after it."""
    inner_names = []
    for name in names:
        inner_names.append(_remove_wrapper_parts(name.removeprefix(prefix)))
    return inner_names


def _common_prefix(names: Sequence[str]) -> str:
    """First prefix of a module around the model that all names start with; empty if none."""
    if not names:  # `all` would be True, and the caller would never stop
        return ""
    for prefix in _OUTER_PREFIXES:
        if all(name.startswith(prefix) for name in names):
            return prefix
    return ""


def _remove_wrapper_parts(key: str) -> str:
    """Remove the parts of a key that wrappers of modules add."""
    parts = [part for part in key.split(".") if part not in _WRAPPER_PARTS]
    name = ".".join(parts)
    while name.startswith(_PARALLEL_PREFIX):
        name = name.removeprefix(_PARALLEL_PREFIX)
    return name
