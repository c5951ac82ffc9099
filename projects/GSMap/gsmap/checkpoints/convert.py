"""Conversion of state dicts between the format of the earlier systems and ours."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsmap.checkpoints.key_map import KeyMap, find_key_map, is_upstream
from gsmap.checkpoints.safe_globals import mmengine_globals


def listed(keys: Sequence[str], shown: int = 3) -> str:
    """Name the first keys and count the rest."""
    rest = f" and {len(keys) - shown} more" if len(keys) > shown else ""
    return ", ".join(keys[:shown]) + rest or "nothing"


def ours_from_upstream(
    state: Mapping[str, Tensor], key_map: KeyMap | None = None
) -> dict[str, Tensor]:
    """Rename an upstream state to our keys; those that the table calls unused are left out.

    Raises:
        ValueError: If a key is not in the table (``key_map``, or the one that the keys tell).
    """
    key_map = key_map or find_key_map(state)
    renamed, unknown = {}, []
    for key, value in state.items():
        ours = key_map.to_ours(key)
        if ours is not None:
            renamed[ours] = value
        elif key not in key_map.unused:
            unknown.append(key)
    if unknown:
        raise ValueError(f"keys that no {key_map.name} model has: {listed(unknown)}.")
    return renamed


def upstream_from_ours(
    state: Mapping[str, Tensor], key_map: KeyMap | None = None
) -> dict[str, Tensor]:
    """Rename our state to upstream's keys and add the ones that only upstream has.

    Auxiliary heads, which serve training alone, are left out where upstream has none.

    Raises:
        ValueError: If another key is not in the table (``key_map``, or the one that the keys tell).
    """
    key_map = key_map or find_key_map(state)
    names = {key: key_map.to_upstream(key) for key in state}
    unknown = [key for key, name in names.items() if name is None and not _serves_training(key)]
    if unknown:
        raise ValueError(
            f"keys that upstream's {key_map.name} does not have: {listed(unknown)}. Without "
            "them the model would find something else: it stays in our format."
        )
    renamed = {name: state[key] for key, name in names.items() if name is not None}
    unused = ((key, value) for key, value in key_map.unused.items() if value is not None)
    return renamed | {k: v.clone(memory_format=torch.contiguous_format) for k, v in unused}


def _serves_training(key: str) -> bool:
    return key.startswith("map_head.aux_heads.")


def read_checkpoint(path: str | Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read a checkpoint file, with or without ``state_dict``, without running any code from it.

    Returns:
        The state dict, and what else the checkpoint says of itself (its ``meta``).

    Raises:
        ValueError: If the file holds no weights.
    """
    with torch.serialization.safe_globals(mmengine_globals()):
        checkpoint: Any = torch.load(path, map_location="cpu", weights_only=True)
    state = checkpoint.get("state_dict", checkpoint) if isinstance(checkpoint, Mapping) else None
    if not state or not all(isinstance(value, Tensor) for value in state.values()):
        raise ValueError(f"{path} holds no state dict of tensors.")
    meta = checkpoint.get("meta") if state is not checkpoint else None
    return {key.removeprefix("module."): value for key, value in state.items()}, meta or {}


def convert_state(state: Mapping[str, Tensor]) -> tuple[dict[str, Tensor], str]:
    """Turn either format into the other, and say in words which way."""
    key_map = find_key_map(state)
    if is_upstream(state):
        return ours_from_upstream(state, key_map), f"{key_map.name}: upstream to gsmap"
    done = f"{key_map.name}: gsmap to upstream"
    left_out = sum(_serves_training(key) and key_map.to_upstream(key) is None for key in state)
    if left_out:
        done += f" without the {left_out} weights of auxiliary heads, which serve training alone"
    return upstream_from_ours(state, key_map), done
