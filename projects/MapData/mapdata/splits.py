"""Which scenes belong to which split, and whether splits overlap on the ground."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from gsmap.utils.files import read_json

OVERLAP_DISTANCE_M = 5.0
# (x, y) in metres of the samples of each split, by map name
Positions = Mapping[str, Mapping[str, list[np.ndarray]]]


def read_split_file(path: Path) -> dict[str, list[str]]:
    """Read a split file: JSON, an object with a list of scene names or tokens for each split.

    It is the format of the nuScenes devkit's own ``splits.json``.
    """
    if not path.is_file():
        raise FileNotFoundError(f"no split file at {path}.")
    splits = read_json(path)
    if not isinstance(splits, dict) or not all(
        isinstance(scenes, list) and all(isinstance(s, str) for s in scenes)
        for scenes in splits.values()
    ):
        raise ValueError(
            f'split file {path} must look like {{"train": ["scene-0001", ...], "val": [...]}}.'
        )
    return splits


def resolve_scenes(
    splits: Mapping[str, Collection[str]], names: Mapping[str, str]
) -> tuple[dict[str, str], list[str]]:
    """Turn scene names or tokens, by split, into the split of each scene that exists.

    Args:
        splits: Names or tokens by split.
        names: Name of each scene of the data set, by token.

    Returns:
        Splits by the scene's name, and the entries that the data set does not have.

    Raises:
        ValueError: If a scene is in two splits, by its name or its token.
    """
    known = {name: name for name in names.values()} | dict(names)
    split_of: dict[str, str] = {}
    missing = []
    for split, entries in splits.items():
        for entry in entries:
            if entry not in known:
                missing.append(entry)
            elif split_of.setdefault(known[entry], split) != split:
                other = split_of[known[entry]]
                raise ValueError(f"scene {known[entry]} is in both {other} and {split}.")
    return split_of, missing


def overlap_share(
    train: Mapping[str, Sequence[np.ndarray]], val: Mapping[str, Sequence[np.ndarray]]
) -> float:
    """Return the share of validation positions within 5 m of a training position on the same map.

    Positions are (x, y) in metres by map name, each (n, 2). Without any the share is 0.
    """
    near = [
        cKDTree(train[name]).query(positions)[0] <= OVERLAP_DISTANCE_M
        for name, positions in val.items()
        if len(positions) and len(train.get(name, ()))
    ]
    total = sum(len(positions) for positions in val.values())
    return sum(int(found.sum()) for found in near) / total if total else 0.0


def overlap_notes(positions: Positions) -> list[str]:
    """Say, if so, how many validation samples lie near a training sample."""
    train = next((s for s in positions if s.endswith("train")), "")
    val = next((s for s in positions if s.endswith("val")), "")
    share = overlap_share(positions[train], positions[val]) if train and val else 0.0
    warning = (
        f"warning: {share:.1%} of the {val} samples lie within 5 m of a {train} sample: "
        "scores on them say little about new places. docs/data.md names disjoint splits."
    )
    return [warning] if share else []
