"""Places that training and validation share: of each sample the distance to the nearest training.

``tools/create_data.py overlap`` reports and draws them.
"""

import argparse
import json
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

OVERLAP_DISTANCE_M = 5.0
_DISTANCES_M = (5.0, 15.0, 30.0, 60.0)  # of the report; 30 and 60: patches of 60 x 30 m can meet
# (x, y) in metres of the samples of each split, by map name
Positions = Mapping[str, Mapping[str, list[np.ndarray]]]
_ByMap = Mapping[str, Sequence[np.ndarray] | np.ndarray]


@dataclass(frozen=True)
class Places:
    """Where the samples of annotation files are; token, scene and map name of each.

    Args:
        tokens: Tokens. (n,)
        scenes: Scenes. (n,)
        maps: Names of maps. (n,)
        positions: (x, y) in metres on the map. (n, 2)
    """

    tokens: np.ndarray
    scenes: np.ndarray
    maps: np.ndarray
    positions: np.ndarray

    def by_map(self) -> dict[str, np.ndarray]:
        """Return the rows of each map, by its name."""
        return {str(name): np.flatnonzero(self.maps == name) for name in np.unique(self.maps)}


def read_places(paths: Sequence[Path]) -> Places:
    """Read the places of annotation files.

    Raises:
        FileNotFoundError: If a file does not exist.
        ValueError: If it is damaged, or does not know poses or maps.
    """
    columns: list[list[str]] = [[], [], []]
    positions = [np.empty((0, 2))]
    for path in paths:
        file = AnnotationFile(path)
        found = [file.column(name) for name in ("token", "scene", "map_name")]
        if not file.meta.options.get("poses", True) or found[1] == found[2]:
            raise InputError(
                f"{path} does not say where its samples are on common maps: make it from the data "
                "set itself, not from info files or pictures."
            )
        for column, values in zip(columns, found, strict=True):
            column += values
        poses = np.array(file.column("global_from_frame"), np.float64).reshape(-1, 4, 4)
        positions.append(poses[:, :2, 3])
    tokens, scenes, maps = (np.array(column, str) for column in columns)
    return Places(tokens, scenes, maps, np.concatenate(positions))


def nearest_by_map(train: _ByMap, val: _ByMap) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Find the nearest training position of each validation position on the same map.

    Args:
        train: (x, y) in metres by map name, each (n, 2).
        val: Likewise.

    Returns:
        By map name distances in metres, infinite without training there, and rows of ``train``.
        2 x (m,)
    """
    nothing = np.empty((0, 2))
    return {
        name: cKDTree(train[name] if len(train.get(name, ())) else nothing).query(positions)
        for name, positions in val.items()
        if len(positions)
    }


def overlap_share(train: _ByMap, val: _ByMap) -> float:
    """Return the share of validation positions within 5 m of a training position on the same map.

    Positions are (x, y) in metres by map name, each (n, 2). Without any the share is 0.
    """
    distances = [distance for distance, _ in nearest_by_map(train, val).values()]
    return float((np.concatenate(distances) <= OVERLAP_DISTANCE_M).mean()) if distances else 0.0


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


def sample_overlap(train: Places, val: Places) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance of each validation sample to the nearest training, and its row. 2 x (m,)

    Distances are metres, infinite on maps without training, where the row is -1.
    """
    distance, nearest = np.full(len(val.tokens), np.inf), np.full(len(val.tokens), -1)
    of_train, of_val = train.by_map(), val.by_map()
    found = nearest_by_map(
        *(
            {name: places.positions[rows] for name, rows in by_map.items()}
            for places, by_map in ((train, of_train), (val, of_val))
        )
    )
    for name, (apart, rows) in found.items():
        distance[of_val[name]] = apart
        if name in of_train:
            nearest[of_val[name]] = of_train[name][rows]
    return distance, nearest


def draw_overlap(train: Places, val: Places, distance_m: np.ndarray) -> "Figure":
    """Draw a panel per map: training grey, validation dark, or red within 5 m of training.

    Args:
        train: Places of training.
        val: Places of validation.
        distance_m: Distance of each validation sample to training. (m,)
    """
    from gsmap.visualization.plots import finish_panel, panel_grid

    names = sorted({*train.by_map(), *val.by_map()})
    columns = min(len(names), 3)
    figure, axes = panel_grid(-(-len(names) // columns), columns)
    near = distance_m <= OVERLAP_DISTANCE_M
    for ax, name in zip(axes.flat, names, strict=False):
        parts = (
            ("training", train, np.ones(len(train.tokens), bool), "#C3C9D1"),
            ("validation", val, ~near, "#1F6FB2"),
            ("validation within 5 m", val, near, "#C8321E"),
        )
        for label, places, chosen, colour in parts:
            at = places.positions[chosen & (places.maps == name)]
            legend = label if name == names[0] else None
            ax.scatter(*at.T, s=1.5, color=colour, label=legend, linewidths=0, rasterized=True)
        ax.set_aspect("equal", "datalim")
        finish_panel(
            ax, name.replace("$", "") or "map", "x (m)", "y (m)", legend={"markerscale": 5}
        )
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
    """Report what validation shares with training, sample by sample."""
    train, val = read_places([arguments.train]), read_places([arguments.val])
    if not len(val.tokens):
        raise InputError(f"{arguments.val} has no sample.")
    distance, nearest = sample_overlap(train, val)
    shared = len({*train.scenes} & {*val.scenes})
    lines = [f"{len(val.tokens)} samples against {len(train.tokens)}; {shared} scenes are in both"]
    lines += [
        f"{(distance <= limit).mean():7.1%} within {limit:g} m of a training sample"
        for limit in _DISTANCES_M
    ]
    for name, rows in val.by_map().items():
        share = (distance[rows] <= OVERLAP_DISTANCE_M).mean()
        lines.append(f"{share:7.1%} of {len(rows)} within 5 m on map {name!r}")
    if arguments.out:
        entries = zip(val.tokens, val.scenes, val.maps, distance, nearest, strict=True)
        samples = [
            {
                "token": str(token), "scene": str(scene), "map": str(name),
                "distance_m": round(float(apart), 3) if row >= 0 else None,
                "nearest": str(train.tokens[row]) if row >= 0 else None,
            }
            for token, scene, name, apart, row in entries
        ]  # fmt: skip
        write_text(arguments.out, json.dumps(samples, indent=1) + "\n")
        lines.append(f"samples: {arguments.out}")
    if arguments.plot:
        from gsmap.visualization.figure import save_figure

        lines.append(f"map: {save_figure(draw_overlap(train, val, distance), arguments.plot)}")
    return "\n".join(lines)
