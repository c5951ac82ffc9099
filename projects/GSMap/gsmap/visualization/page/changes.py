"""Map changes on the report page: lines in the frames, and a table of all changes.

A change is a map element, or a part of one, that was added, removed or moved since an old map was
made.
"""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.annotations.record import MapSample
from gsmap.evaluation.analysis.change_files import KINDS, MapChange, read_changes
from gsmap.evaluation.analysis.changes import level_pose, with_map_names
from gsmap.structures.elements import MapElements
from gsmap.structures.frames import FrameView
from gsmap.structures.polylines import clip_to_box, is_closed
from gsmap.structures.rigid import invert_rigid
from gsmap.utils.errors import InputError
from gsmap.utils.words import format_count
from gsmap.visualization.page.frames import to_centimetres
from gsmap.visualization.page.tables import Table


class ChangeLayer:
    """Changes of the maps to which the samples of an annotation file belong.

    Args:
        path: File of ``build_map.py --changes`` or of MiniCity; None for no changes.
        file: Annotation file.

    Raises:
        FileNotFoundError: If the file of changes does not exist.
        ValueError: If the file of changes is malformed, or the annotation file has no poses.
    """

    def __init__(self, path: Path | None, file: AnnotationFile) -> None:
        if path and not file.meta.has_poses:
            raise InputError(f"{file.path} knows no poses, which changes need.")
        maps = sorted(set(file.column("map_name")))
        changes = read_changes(path) if path else []
        # Changes that name no map get the name of the only map of the annotation file.
        self._changes = with_map_names(changes, maps, where=str(path))
        self._has_file = path is not None
        self._meta = file.meta
        self._shown: set[int] = set()  # indices of the changes that `entries` has returned

    def entries(self, sample: MapSample, view: FrameView) -> list[dict[str, Any]]:
        """Convert the changes in range of a sample to plain values.

        Args:
            sample: Sample of the annotation file.
            view: Orientation of the annotation frame.

        Returns:
            A dictionary for each piece of a change in the range: its kind (``kind``), a description
            (``text``) and its points (``p``), a flat list of (right, ahead) in whole centimetres.
        """
        # Changes have no height, so roll and pitch would shift points far from the origin.
        frame_from_global = invert_rigid(level_pose(sample.global_from_frame))
        entries = []
        for index, change in enumerate(self._changes):
            if change.map_name != sample.map_name:
                continue
            # Only the points are used. The label 0 is arbitrary.
            line = MapElements.from_polylines([change.points], [0]).to_frame(frame_from_global)
            pieces = clip_to_box(line.points, self._meta.x_range, self._meta.y_range)
            if pieces and is_closed(line.points):
                # The outline of an area is drawn as a whole, because cutting would open it.
                pieces = [line.points]
            for piece in pieces:
                self._shown.add(index)
                entry = {
                    "kind": change.kind,
                    "text": _describe(change),
                    "p": to_centimetres(piece, view),
                }
                entries.append(entry)
        return entries

    def notes(self) -> list[str]:
        """Return a sentence with the number of changes, in total and returned by `entries`.

        The list is empty without a file of changes.
        """
        if not self._has_file:
            return []
        counts = Counter(change.kind for change in self._changes)
        parts = [f"{counts[kind]} {kind}" for kind in KINDS]
        total = format_count(len(self._changes), noun="change")
        return [f"{total} of the map: {', '.join(parts)}; {len(self._shown)} in these frames."]

    def tables(self) -> list[Table]:
        """Return a table of all changes, by falling confidence; empty without a file of changes."""
        if not self._has_file:
            return []
        rows = []
        for change in sorted(self._changes, key=lambda each: -each.confidence):
            rows.append(_row(change))
        head = ["class", "change", "map", "by", "drives", "confidence", "near (global frame)"]
        return [{"caption": "Changes of the map", "head": head, "rows": rows}]


def _distance(change: MapChange) -> str:
    """Format the distance of a moved element with its standard error; empty for other changes."""
    if change.moved_m is None:
        return ""
    if change.moved_std_m is None:
        return f"{change.moved_m:.2f} m"
    return f"{change.moved_m:.2f} \N{PLUS-MINUS SIGN} {change.moved_std_m:.2f} m"


def _drives(change: MapChange) -> str:
    """Format how many of the drives past a change confirm it; empty if unknown."""
    if change.passes is None:
        return ""
    agreeing, in_view = change.passes
    return f"{agreeing} of {in_view}"


def _describe(change: MapChange) -> str:
    """Describe a change in a few words."""
    parts = [f"{change.class_name} {change.kind}"]
    if change.moved_m is not None:
        parts.append(f"by {_distance(change)}")
    if change.passes is not None:
        parts.append(f"({_drives(change)} drives)")
    return " ".join(parts)


def _row(change: MapChange) -> Sequence[str]:
    """Return the row of a change in the table, with the mean of its vertices as its place."""
    x, y = np.mean(change.points, axis=0)
    return [
        change.class_name,
        change.kind,
        change.map_name,
        _distance(change),
        _drives(change),
        f"{change.confidence:.2f}",
        f"{x:.0f} m, {y:.0f} m",
    ]
