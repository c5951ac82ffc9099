"""Overlap of training and validation: distances of validation samples to training samples.

``tools/create_data.py overlap`` reports and draws the overlap.
"""

import argparse
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.utils.cli import output_file
from gsmap.utils.errors import InputError
from gsmap.utils.files import write_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# A validation sample overlaps with training if a training sample is within this distance.
OVERLAP_DISTANCE_M = 5.0
# Distances of the report. The maps of two samples, patches of 60 x 30 m, overlap up to a distance
# of 30 m if they are side by side, and up to 60 m if one is behind the other.
_DISTANCES_M = (5.0, 15.0, 30.0, 60.0)
# Positions (x, y) of samples in metres, by split and then by map name.
Positions = Mapping[str, Mapping[str, list[np.ndarray]]]
# Positions (x, y) of samples in metres, by map name: arrays (n, 2), or lists of arrays (2,).
_ByMap = Mapping[str, Sequence[np.ndarray] | np.ndarray]


@dataclass(frozen=True)
class Places:
    """Positions of the samples of annotation files.

    Args:
        tokens: Token of each sample. (n,)
        scenes: Scene of each sample. (n,)
        maps: Name of the map of each sample. (n,)
        positions: (x, y) of each sample on its map, in metres. (n, 2)
    """

    tokens: np.ndarray
    scenes: np.ndarray
    maps: np.ndarray
    positions: np.ndarray

    def by_map(self) -> dict[str, np.ndarray]:
        """Rows of the samples on each map in ascending order, by the name of the map."""
        return {str(name): np.flatnonzero(self.maps == name) for name in np.unique(self.maps)}

    def positions_by_map(self) -> dict[str, np.ndarray]:
        """(x, y) of the samples on each map in metres, by the name of the map. Each (n, 2)"""
        positions = {}
        for name, rows in self.by_map().items():
            positions[name] = self.positions[rows]
        return positions

    def select(self, rows: np.ndarray) -> "Places":
        """Select samples by their row indices (m,), or by a mask (n,)."""
        return Places(
            tokens=self.tokens[rows],
            scenes=self.scenes[rows],
            maps=self.maps[rows],
            positions=self.positions[rows],
        )


def read_places(paths: Sequence[Path]) -> Places:
    """Read the positions of the samples of annotation files.

    Raises:
        FileNotFoundError: If a file does not exist.
        ValueError: If a file is damaged, or has no poses or no map names.
    """
    tokens: list[str] = []
    scenes: list[str] = []
    maps: list[str] = []
    positions = [np.empty((0, 2))]
    for path in paths:
        file = AnnotationFile(path)
        file_scenes = file.column("scene")
        file_maps = file.column("map_name")
        # A conversion that does not know the names of the maps writes the scene as map name, or no
        # name.
        has_common_maps = file_scenes != file_maps and "" not in file_maps
        if not file.meta.has_poses or not has_common_maps:
            raise InputError(
                f"{path} does not say where its samples are on common maps: make it from the data "
                "set itself, not from info files or pictures, and give records a map_name."
            )
        tokens += file.column("token")
        scenes += file_scenes
        maps += file_maps
        poses = np.array(file.column("global_from_frame"), np.float64).reshape(-1, 4, 4)
        positions.append(poses[:, :2, 3])
    return Places(
        tokens=np.array(tokens, str),
        scenes=np.array(scenes, str),
        maps=np.array(maps, str),
        positions=np.concatenate(positions),
    )


def nearest_by_map(train: _ByMap, val: _ByMap) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Find the nearest training position of each validation position, map by map.

    Args:
        train: (x, y) of the training samples in metres, by map name. each (n, 2)
        val: (x, y) of the validation samples in metres, by map name. each (m, 2)

    Returns:
        Two arrays for each map with validation samples, by its name. First, the distance of each
        validation sample in metres, infinite if the map has no training sample. (m,) Second, the
        row of its nearest training sample among the training samples of the map. (m,) The row has
        no meaning where the distance is infinite.
    """
    nearest = {}
    for name, positions in val.items():
        if len(positions):
            train_positions = train.get(name, ())
            if len(train_positions) == 0:
                train_positions = np.empty((0, 2))
            tree = cKDTree(train_positions)
            nearest[name] = tree.query(positions)  # distances and rows
    return nearest


def overlap_share(train: _ByMap, val: _ByMap) -> float:
    """Share of the validation positions within 5 m of a training position, map by map.

    Args:
        train: (x, y) of the training samples in metres, by map name. each (n, 2)
        val: (x, y) of the validation samples in metres, by map name. each (m, 2)

    Returns:
        The share in [0, 1]; 0 if there are no validation positions.
    """
    distances = [distance for distance, _ in nearest_by_map(train, val).values()]
    if not distances:
        return 0.0
    return float((np.concatenate(distances) <= OVERLAP_DISTANCE_M).mean())


def overlap_notes(positions: Positions) -> list[str]:
    """List with a warning about validation samples near training samples; empty if none is near."""
    # The names may have a prefix, as in nuScenes' split "mini_train".
    train = next((split for split in positions if split.endswith("train")), "")
    val = next((split for split in positions if split.endswith("val")), "")
    if not train or not val:
        return []
    share = overlap_share(positions[train], positions[val])
    if not share:
        return []
    warning = (
        f"warning: {share:.1%} of the {val} samples lie within 5 m of a {train} sample: "
        "scores on them say little about new places. docs/data.md names disjoint splits."
    )
    return [warning]


def sample_overlap(train: Places, val: Places) -> tuple[np.ndarray, np.ndarray]:
    """Find the nearest training sample of each validation sample, map by map.

    Args:
        train: Positions of the training samples.
        val: Positions of the validation samples.

    Returns:
        Distance of each validation sample in metres (m,), and the row of its nearest training
        sample (m,). On maps without training samples, the distance is infinite and the row is -1.
    """
    distance = np.full(len(val.tokens), np.inf)
    nearest = np.full(len(val.tokens), -1)
    train_rows = train.by_map()
    val_rows = val.by_map()
    by_map = nearest_by_map(train.positions_by_map(), val.positions_by_map())
    # `rows` count the training samples of one map. `train_rows` gives their rows in `train`.
    for name, (distances, rows) in by_map.items():
        distance[val_rows[name]] = distances
        if name in train_rows:
            nearest[val_rows[name]] = train_rows[name][rows]
    return distance, nearest


def draw_overlap(train: Places, val: Places, distance_m: np.ndarray) -> "Figure":
    """Draw a panel per map with the positions of the samples.

    Training samples are grey and validation samples are blue. Validation samples within 5 m of a
    training sample are red.

    Args:
        train: Positions of the training samples.
        val: Positions of the validation samples.
        distance_m: Distance of each validation sample to the nearest training sample, in metres.
            (m,)

    Returns:
        The figure.
    """
    from gsmap.visualization.plots import finish_panel, panel_grid

    names = sorted({*train.by_map(), *val.by_map()})
    columns = min(len(names), 3)
    rows = math.ceil(len(names) / columns)
    figure, axes = panel_grid(rows, columns)
    near = distance_m <= OVERLAP_DISTANCE_M
    layers = (  # label, samples and colour; later layers cover earlier ones
        ("training", train, "#C3C9D1"),
        ("validation", val.select(~near), "#1F6FB2"),
        ("validation within 5 m", val.select(near), "#C8321E"),
    )
    for ax, name in zip(axes.flat, names, strict=False):
        for label, places, colour in layers:
            positions = places.positions[places.maps == name]
            ax.scatter(
                positions[:, 0],
                positions[:, 1],
                s=1.5,
                color=colour,
                label=label if name == names[0] else None,  # only the first panel has a legend
                linewidths=0,
                rasterized=True,
            )
        ax.set_aspect("equal", "datalim")
        title = name.replace("$", "") or "map"  # matplotlib reads "$" as the start of a formula
        finish_panel(ax, title, "x (m)", "y (m)", legend={"markerscale": 5})
    for ax in axes.flat[len(names) :]:
        ax.set_axis_off()
    return figure


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``tools/create_data.py overlap``."""
    add = parser.add_argument
    add("train", type=Path, help="annotation file of training (.arrow)")
    add("val", type=Path, help="annotation file of validation")
    add("--out", type=output_file, help="write each sample's distance to training as JSON")
    add("--plot", type=output_file, help="draw a map of both, such as overlap.png")


def run(arguments: argparse.Namespace) -> str:
    """Run the command ``overlap`` and return its report."""
    train = read_places([arguments.train])
    val = read_places([arguments.val])
    if not len(val.tokens):
        raise InputError(f"{arguments.val} has no sample.")
    distance, nearest = sample_overlap(train, val)
    common = len({*train.scenes} & {*val.scenes})  # number of scenes in both
    lines = [f"{len(val.tokens)} samples against {len(train.tokens)}; {common} scenes are in both"]
    for limit_m in _DISTANCES_M:
        share = (distance <= limit_m).mean()
        lines.append(f"{share:7.1%} within {limit_m:g} m of a training sample")
    for name, rows in val.by_map().items():
        share = (distance[rows] <= OVERLAP_DISTANCE_M).mean()
        lines.append(f"{share:7.1%} of {len(rows)} within 5 m on map {name!r}")
    if arguments.out:
        samples = []
        for val_row, train_row in enumerate(nearest):
            has_training = train_row >= 0
            sample = {
                "token": str(val.tokens[val_row]),
                "scene": str(val.scenes[val_row]),
                "map": str(val.maps[val_row]),
                "distance_m": round(float(distance[val_row]), 3) if has_training else None,
                "nearest": str(train.tokens[train_row]) if has_training else None,
            }
            samples.append(sample)
        write_text(arguments.out, json.dumps(samples, indent=1) + "\n")
        lines.append(f"samples: {arguments.out}")
    if arguments.plot:
        from gsmap.visualization.figure import save_figure

        figure = draw_overlap(train, val, distance_m=distance)
        lines.append(f"map: {save_figure(figure, arguments.plot)}")
    return "\n".join(lines)
