"""A drive as a film: cameras with predictions, predictions and the growing map from above."""

from pathlib import Path

import numpy as np

from drivemaps.replay import Moment, Replay
from gsmap.structures.elements import MapElements
from gsmap.structures.grid import BEVGrid
from gsmap.visualization.bev_view import BEVPanel
from gsmap.visualization.camera_view import camera_views
from gsmap.visualization.figure import compose_figure, figure_to_rgb
from gsmap.visualization.film import write_film
from gsmap.visualization.style import MapStyle


def write_video(path: str | Path, replay: Replay, width_px: int = 1280) -> None:
    """Write a film (``.mp4``) in H.264, as fast as the drive was; an empty map has no panel.

    Args:
        path: File to write.
        replay: The drive and its map.
        width_px: Width of the film in pixels.

    Raises:
        ValueError: If an image is missing or damaged.
        RuntimeError: If ``av`` (PyAV) is missing.
    """
    times_ns = [frame.sample.timestamp_ns for frame in replay.drive.frames]
    pictures = (_picture(moment, replay, width_px) for moment in replay.moments())
    write_film(path, pictures, times_ns)


def _picture(moment: Moment, replay: Replay, width_px: int) -> np.ndarray:
    """Draw one moment. (H, W, 3)"""
    frame, sample, drive = moment.frame, moment.frame.sample, replay.drive
    found = MapElements.from_polylines(moment.lines, frame.elements.labels, frame.elements.scores)
    panels, cameras = [BEVPanel("Prediction", found)], []
    if len(replay.elements):
        lines = [frame.to_frame(points[:, :2]) for _, points in moment.seen]
        seen = MapElements.from_polylines(lines, [label for label, _ in moment.seen])
        panels.append(BEVPanel("Map so far", seen))
    if replay.data_root is not None:
        cameras = camera_views(sample.cameras, replay.data_root, sample.token)
    figure = compose_figure(
        cameras,
        panels,
        BEVGrid(drive.x_range, drive.y_range),
        replay.view.with_mounting(sample.ego_from_frame),
        MapStyle(classes=drive.classes),
        found,
        drive.scene,
        width_px,
    )
    return figure_to_rgb(figure)
