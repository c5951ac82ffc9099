"""Conversion of state dicts between the format of the earlier systems and ours."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from gsmap.checkpoints.key_map import find_key_map, is_upstream
from gsmap.utils.errors import InputError

_TRAINING = "map_head.aux_heads."  # begins what serves training alone


def listed(keys: Sequence[str], shown: int = 3) -> str:
    """Name the first keys and count the rest."""
    rest = f" and {len(keys) - shown} more" if len(keys) > shown else ""
    return ", ".join(keys[:shown]) + rest or "nothing"


def ours_from_upstream(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Rename an upstream state to our keys; those that the table calls unused are left out.

    Raises:
        ValueError: If a key is not in the table that the keys tell.
    """
    key_map = find_key_map(state)
    names = {key: key_map.to_ours(key) for key in state}
    unknown = [key for key, name in names.items() if name is None and not key_map.is_unused(key)]
    if unknown:
        raise InputError(f"keys that no {key_map.name} model has: {listed(unknown)}.")
    return {name: state[key] for key, name in names.items() if name is not None}


def upstream_from_ours(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Rename our state to upstream's keys and add the ones that only upstream has.

    Auxiliary heads, which serve training alone, are left out where upstream has none.

    Raises:
        ValueError: If another key is not in the table that the keys tell.
    """
    key_map = find_key_map(state)
    names = {key: key_map.to_upstream(key) for key in state}
    unknown = [key for key, name in names.items() if name is None and not key.startswith(_TRAINING)]
    if unknown:
        raise InputError(
            f"keys that upstream's {key_map.name} does not have: {listed(unknown)}. Without "
            "them the model would find something else: it stays in our format."
        )
    renamed = {name: state[key] for key, name in names.items() if name is not None}
    unused = ((key, value) for key, value in key_map.unused.items() if value is not None)
    return renamed | {k: v.clone(memory_format=torch.contiguous_format) for k, v in unused}


def convert_state(state: Mapping[str, Tensor]) -> tuple[dict[str, Tensor], str]:
    """Turn either format into the other, and say in words which way."""
    key_map = find_key_map(state)
    if is_upstream(state):
        return ours_from_upstream(state), f"{key_map.name}: upstream to gsmap"
    done = f"{key_map.name}: gsmap to upstream"
    left_out = sum(key.startswith(_TRAINING) and key_map.to_upstream(key) is None for key in state)
    if left_out:
        done += f" without the {left_out} weights of auxiliary heads, which serve training alone"
    return upstream_from_ours(state), done
