"""Videos of drives: cameras with predictions, and the growing map in bird's-eye view."""

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
    """Write a drive as a video in H.264 (``.mp4``) that plays in real time.

    There is one picture for each frame. It shows the cameras (if the replay has a data root), the
    predictions of the frame from above and, unless the map of the drive is empty, the map up to the
    frame.

    Args:
        path: File to write.
        replay: Drive with its predictions, map and images.
        width_px: Width of the video in pixels.

    Raises:
        ValueError: If an image is missing or damaged.
        RuntimeError: If ``av`` (PyAV) is missing.
    """
    times_ns = [frame.sample.timestamp_ns for frame in replay.drive.frames]
    # A generator, so that only one picture is in memory. There is one moment for each frame, in the
    # order of time, so the pictures and `times_ns` correspond.
    pictures = (_draw_moment(moment, replay, width_px=width_px) for moment in replay.moments())
    write_film(path, pictures, times_ns)


def _draw_moment(moment: Moment, replay: Replay, width_px: int) -> np.ndarray:
    """Draw a frame and the map up to it as an RGB image. (H, W, 3), uint8"""
    frame = moment.frame
    sample = frame.sample
    drive = replay.drive
    elements = frame.elements  # in the global frame
    # ``moment.lines`` are the lines of these elements in the annotation frame, in equal order,
    # raised to the ground.
    predictions = MapElements.from_polylines(
        moment.lines, labels=elements.labels, scores=elements.scores
    )
    panels = [BEVPanel("Prediction", predictions)]
    has_map = len(replay.elements) > 0
    if has_map:
        lines = []
        labels = []
        for label, global_points in moment.map_lines:
            # A view from above needs no heights. `to_frame` takes x and y to the annotation frame.
            lines.append(frame.to_frame(global_points[:, :2]))
            labels.append(label)
        panels.append(BEVPanel("Map so far", MapElements.from_polylines(lines, labels)))
    cameras = []
    if replay.data_root is not None:
        cameras = camera_views(sample.cameras, replay.data_root, token=sample.token)
    figure = compose_figure(
        cameras,
        panels,
        grid=BEVGrid(x_range=drive.x_range, y_range=drive.y_range),
        # Orientation of the annotation frame, with the ground plane from the sensor's mounting.
        view=replay.view.with_mounting(sample.ego_from_frame),
        style=MapStyle(classes=drive.classes),
        camera_elements=predictions,  # drawn over the images
        title=drive.name,
        width_px=width_px,
    )
    return figure_to_rgb(figure)
