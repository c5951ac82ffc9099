"""Splits of scenes by place, in which validation samples keep a distance from training samples."""

import argparse
import json
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from gsmap.utils.cli import EachOnce, output_file
from gsmap.utils.errors import InputError
from gsmap.utils.files import write_text
from mapdata.overlap import Places, read_places, sample_overlap


def _near_scenes(scenes: np.ndarray, positions: np.ndarray, distance_m: float) -> np.ndarray:
    """Find the pairs of scenes that have samples within a distance of each other.

    Args:
        scenes: Index of the scene of each sample, in [0, S). (n,)
        positions: (x, y) of each sample in metres. (n, 2)
        distance_m: The distance in metres.

    Returns:
        True for pairs of near scenes; a scene is near itself. (S, S)
    """
    count = scenes.max() + 1
    near = np.zeros((count, count), dtype=bool)
    tree = cKDTree(positions)
    for scene in range(count):
        neighbours = tree.query_ball_point(positions[scenes == scene], distance_m)
        # Samples of any scene that are near a sample of this scene.
        samples = np.unique(np.concatenate(neighbours).astype(np.int64))
        near[scene, scenes[samples]] = True
    return near | near.T  # symmetric despite rounding errors of distances


def _select_scenes(near: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Select scenes of a map for validation, one after another.

    A selected scene and the scenes near it are lost for training. The first scene is random. Each
    further scene is the one by which training loses the fewest additional scenes.

    Args:
        near: Whether two scenes are near each other; a scene is near itself. (S, S)
        count: Number of scenes to select, in [1, S].
        rng: Source of the random order.

    Returns:
        Mask of the selected scenes. (S,)
    """
    rank = rng.permutation(len(near))  # random rank of each scene, which decides between equals
    selected = np.zeros(len(near), dtype=bool)
    covered = np.zeros(len(near), dtype=bool)  # selected scenes and scenes near them
    scene = int(rank.argmin())
    while True:
        selected[scene] = True
        covered |= near[scene]
        if selected.sum() >= count:
            return selected
        # Column j of `near` is scene j; scenes that are already covered are lost anyway.
        num_lost = (near & ~covered).sum(1)  # scenes that training would lose with each scene
        others = np.flatnonzero(~selected)
        # `lexsort` sorts by its last key first: by loss, then by rank.
        order = np.lexsort((rank[others], num_lost[others]))
        scene = int(others[order[0]])


def split_scenes(
    places: Places, min_distance_m: float, val_share: float, seed: int
) -> dict[str, list[str]]:
    """Split scenes so that no validation sample is near a training sample.

    Each map gives about an equal share of its scenes to validation. Other scenes near validation
    scenes are in neither part. The split depends on the arguments only.

    Args:
        places: Positions of the samples, with the scene and the map of each.
        min_distance_m: Least distance between samples of the two parts, in metres, >= 0.
        val_share: Share of the scenes for validation, in (0, 1).
        seed: Seed of the random order of scenes, >= 0.

    Returns:
        Names of the scenes of ``train`` and ``val``, sorted.

    Raises:
        ValueError: If a value is out of its range, or a part is empty.
    """
    if not (0 < val_share < 1 and 0 <= min_distance_m < np.inf and seed >= 0):
        raise InputError(
            "the share of validation must be in (0, 1), the distance and the seed >= 0, got "
            f"{val_share}, {min_distance_m} and {seed}."
        )
    rng = np.random.default_rng(seed)
    names, scenes = np.unique(places.scenes, return_inverse=True)  # index of each sample's scene
    # A scene may be on several maps. It is near the scenes that it is near on any of them.
    is_near = np.zeros((len(names), len(names)), dtype=bool)
    is_val = np.zeros(len(names), dtype=bool)
    for rows in places.by_map().values():
        # `indices` are the scenes on this map, and `map_scenes` has the place of each sample's
        # scene among them.
        indices, map_scenes = np.unique(scenes[rows], return_inverse=True)
        near = _near_scenes(map_scenes, places.positions[rows], distance_m=min_distance_m)
        is_near[np.ix_(indices, indices)] |= near
        count = round(val_share * len(indices))
        if count:  # a map with few scenes is used for training only
            is_val[indices[_select_scenes(near, count=count, rng=rng)]] = True
    is_train = ~is_near[is_val].any(axis=0)  # validation scenes are near themselves
    parts = {"train": names[is_train].tolist(), "val": names[is_val].tolist()}
    if not parts["train"] or not parts["val"]:
        raise InputError(
            f"{len(names)} scenes leave {len(parts['train'])} for training and "
            f"{len(parts['val'])} for validation: give a smaller --min-distance, or another "
            "--val-share."
        )
    return parts


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``tools/create_data.py split``."""
    add = parser.add_argument
    files_help = "annotation files with the scenes to split (.arrow)"
    add("files", type=Path, nargs="+", action=EachOnce, help=files_help)
    add("--out", type=output_file, required=True, help="split file to write (.json)")
    add(
        "--min-distance", type=float, default=60.0, metavar="M",
        help="metres between samples of training and validation (default: %(default)s)",
    )  # fmt: skip
    text = "share of each map's scenes for validation (default: %(default)s)"
    add("--val-share", type=float, default=0.15, help=text)
    add("--seed", type=int, default=0, help="seed of the random choice (default: %(default)s)")


def run(arguments: argparse.Namespace) -> str:
    """Run the command ``split``: write a split, and return a summary of its sizes and distance.

    Raises:
        ValueError: If the scenes cannot be split (`split_scenes`).
    """
    places = read_places(arguments.files)
    parts = split_scenes(
        places,
        min_distance_m=arguments.min_distance,
        val_share=arguments.val_share,
        seed=arguments.seed,
    )
    train = places.select(np.isin(places.scenes, parts["train"]))
    val = places.select(np.isin(places.scenes, parts["val"]))
    # Distance in metres of each validation sample from the nearest training sample on its map.
    distance, _ = sample_overlap(train, val)
    write_text(arguments.out, json.dumps(parts, indent=1) + "\n")
    left_out = len(np.unique(places.scenes)) - len(parts["train"]) - len(parts["val"])
    return (
        f"train {len(parts['train'])} scenes ({len(train.tokens)} samples), "
        f"val {len(parts['val'])} scenes ({len(val.tokens)} samples); "
        f"{left_out} scenes near validation scenes are left out; the nearest samples are "
        f"{distance.min():.1f} m apart\n{arguments.out}: give it to create_data.py as --split-file"
    )
