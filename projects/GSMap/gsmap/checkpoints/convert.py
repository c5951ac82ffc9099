"""Conversion of state dicts between the format of this project and the upstream format.

"Upstream" is the code that the authors of a model have released. The key map (`KeyMap`) of an
architecture has the rules that rename the keys of its weights in both directions.
"""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from gsmap.checkpoints.key_map import find_key_map, is_upstream
from gsmap.utils.errors import InputError
from gsmap.utils.words import format_count

_TRAINING_ONLY = "map_head.aux_heads."  # prefix of weights that only training uses


def summarize_names(names: Sequence[str], max_names: int = 3) -> str:
    """Join the first names for a message, and append the number of further names.

    Args:
        names: State keys, or other names.
        max_names: Number of names to write out.

    Returns:
        Text such as ``a, b, c and 5 more``; ``nothing`` without names.
    """
    if not names:
        return "nothing"
    rest = f" and {len(names) - max_names} more" if len(names) > max_names else ""
    return ", ".join(names[:max_names]) + rest


def ours_from_upstream(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Rename the keys of an upstream state to the keys of this project.

    Keys that the key map marks as unused have no counterpart in this project. They are left out.

    Args:
        state: Weights by upstream key.

    Returns:
        Weights by the keys of this project. The tensors are not copied.

    Raises:
        ValueError: If the key map does not contain a key, or ``state`` is empty.
    """
    key_map = find_key_map(state)
    renamed: dict[str, Tensor] = {}
    unknown: list[str] = []
    for key, value in state.items():
        name = key_map.to_ours(key)  # None if the key is unused or not known
        if name is not None:
            renamed[name] = value
        elif not key_map.is_unused(key):
            unknown.append(key)
    if unknown:
        raise InputError(f"keys that no {key_map.name} model has: {summarize_names(unknown)}.")
    return renamed


def upstream_from_ours(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Rename the keys of a state to upstream's keys, and add the weights that only upstream has.

    Weights of auxiliary heads are left out if the upstream architecture does not contain them,
    since only training uses them.

    Args:
        state: Weights by the keys of this project.

    Returns:
        Weights by upstream key. Tensors of ``state`` are not copied.

    Raises:
        ValueError: If a weight outside of the auxiliary heads has no upstream key, or ``state`` is
            empty.
    """
    key_map = find_key_map(state)
    renamed: dict[str, Tensor] = {}
    unknown: list[str] = []
    for key, value in state.items():
        name = key_map.to_upstream(key)  # None if no rule matches
        if name is not None:
            renamed[name] = value
        elif not key.startswith(_TRAINING_ONLY):
            unknown.append(key)
    if unknown:
        raise InputError(
            f"keys that upstream's {key_map.name} does not have: {summarize_names(unknown)}. "
            "Without these weights the model would predict other maps, so it is not converted."
        )
    # For each key that only upstream has, `unused` contains a constant weight, or None.
    for key, constant in key_map.unused.items():
        if constant is not None:  # None marks a key that only some upstream models have
            # Some constants are expanded tensors, whose elements share memory. A clone in this
            # format has memory for each element.
            renamed[key] = constant.clone(memory_format=torch.contiguous_format)
    return renamed


def convert_state(state: Mapping[str, Tensor]) -> tuple[dict[str, Tensor], str]:
    """Convert a state from either format to the other.

    Args:
        state: Weights by the keys of upstream or of this project.

    Returns:
        The converted state, and a description of the conversion for a log.

    Raises:
        ValueError: If a key belongs to no known architecture, if upstream's architecture lacks a
            weight outside of the auxiliary heads, or if ``state`` is empty.
    """
    key_map = find_key_map(state)
    if is_upstream(state):
        ours = ours_from_upstream(state)
        description = f"{key_map.name}: upstream to gsmap"
        unused = [key for key in state if key_map.is_unused(key)]
        if unused:
            names = summarize_names(unused)
            description += f" without {format_count(len(unused), 'key')} of no use here ({names})"
        return ours, description
    description = f"{key_map.name}: gsmap to upstream"
    num_left_out = 0
    for key in state:
        if key.startswith(_TRAINING_ONLY) and key_map.to_upstream(key) is None:
            num_left_out += 1
    if num_left_out:
        description += (
            f" without the {num_left_out} weights of auxiliary heads, which serve training alone"
        )
    return upstream_from_ours(state), description
