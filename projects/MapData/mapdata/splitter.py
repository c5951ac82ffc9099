"""Splits of scenes by place: validation keeps a distance from training, others are left out."""

import argparse
import json
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from gsmap.utils.cli import output_file
from gsmap.utils.errors import InputError
from gsmap.utils.files import write_text
from mapdata.overlap import Places, read_places, sample_overlap


def _near(scenes: np.ndarray, positions: np.ndarray, distance_m: float) -> np.ndarray:
    """Return which scenes of a map come how near to each other, themselves too. (S, S)

    ``scenes`` are the numbers of the samples' scenes (n,), ``positions`` metres (n, 2).
    """
    near = np.zeros((scenes.max() + 1,) * 2, bool)
    tree = cKDTree(positions)
    for scene in range(len(near)):
        beside = tree.query_ball_point(positions[scenes == scene], distance_m)
        near[scene, scenes[np.unique(np.concatenate(beside).astype(np.int64))]] = True
    return near | near.T


def _grow(near: np.ndarray, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Choose scenes of a map from a random one on, always what costs training the least.

    Returns which are chosen, and which are neither chosen nor near a chosen one. 2 x (S,)
    """
    rank = rng.permutation(len(near))
    chosen, covered = np.zeros(len(near), bool), np.zeros(len(near), bool)
    scene = int(rank.argmin())
    while True:
        chosen[scene] = True
        covered |= near[scene]
        if chosen.sum() >= count:
            return chosen, ~covered
        cost = (near & ~covered).sum(1)
        scene = min(np.flatnonzero(~chosen).tolist(), key=lambda s: (cost[s], rank[s]))


def split_scenes(
    places: Places, min_distance_m: float, val_share: float, seed: int
) -> dict[str, list[str]]:
    """Split scenes so that no sample of validation is near one of training.

    Each map gives about the same share of its scenes to validation. Scenes near those of validation
    are in neither part. The same input makes the same split.

    Args:
        places: Where the samples are.
        min_distance_m: Distance in metres that samples of both parts exceed.
        val_share: Share of the scenes for validation, in (0, 1).
        seed: Of the random choice of where validation begins.

    Returns:
        Names of scenes of ``train`` and ``val``, sorted.

    Raises:
        ValueError: If a value is out of its range, or nothing is left for training.
    """
    if not (0 < val_share < 1 and 0 <= min_distance_m < np.inf and seed >= 0):
        raise InputError(
            "the share of validation must be in (0, 1), the distance and the seed >= 0, got "
            f"{val_share}, {min_distance_m} and {seed}."
        )
    rng = np.random.default_rng(seed)
    parts: dict[str, list[str]] = {"train": [], "val": []}
    for rows in places.by_map().values():
        names, scenes = np.unique(places.scenes[rows], return_inverse=True)
        count = round(val_share * len(names))
        near = _near(scenes, places.positions[rows], min_distance_m)
        nothing = np.zeros(len(names), bool), np.ones(len(names), bool)
        chosen, far = _grow(near, count, rng) if count else nothing
        parts["train"] += names[far].tolist()
        parts["val"] += names[chosen].tolist()
    if not parts["train"] or not parts["val"]:
        raise InputError(
            f"{len(np.unique(places.scenes))} scenes leave {len(parts['train'])} for training and "
            f"{len(parts['val'])} for validation: give a smaller --min-distance, or another "
            "--val-share."
        )
    return {part: sorted(set(names)) for part, names in parts.items()}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``tools/create_data.py split``."""
    add = parser.add_argument
    add("files", type=Path, nargs="+", help="annotation files with the scenes to split (.arrow)")
    add("--out", type=output_file, required=True, help="split file to write (.json)")
    add(
        "--min-distance", type=float, default=60.0, metavar="M",
        help="metres between samples of training and validation (default: %(default)s)",
    )  # fmt: skip
    text = "share of each map's scenes for validation (default: %(default)s)"
    add("--val-share", type=float, default=0.15, help=text)
    add(
        "--seed", type=int, default=0, help="another one makes another split (default: %(default)s)"
    )


def run(arguments: argparse.Namespace) -> str:
    """Write a split and say how large its parts are, and how far apart."""
    places = read_places(arguments.files)
    options = arguments.min_distance, arguments.val_share, arguments.seed
    parts = split_scenes(places, *options)
    of_part = {part: np.isin(places.scenes, names) for part, names in parts.items()}
    chosen = [
        Places(*(values[rows] for values in vars(places).values())) for rows in of_part.values()
    ]
    distance, _ = sample_overlap(*chosen)
    write_text(arguments.out, json.dumps(parts, indent=1) + "\n")
    left_out = len(np.unique(places.scenes)) - sum(map(len, parts.values()))
    sizes = ", ".join(
        f"{part} {len(names)} scenes ({of_part[part].sum()} samples)"
        for part, names in parts.items()
    )
    return (
        f"{sizes}; {left_out} scenes near both are left out; the nearest samples are "
        f"{distance.min():.1f} m apart\n{arguments.out}: give it to create_data.py as --split-file"
    )
