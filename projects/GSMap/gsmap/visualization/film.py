"""Films of drives in H.264: cameras, and the maps of results beside the ground truth."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.evaluation.analysis.consistency import DriveFrame
from gsmap.evaluation.analysis.drive_files import drive_frames
from gsmap.structures.frames import frame_view
from gsmap.structures.grid import BEVGrid
from gsmap.utils.errors import InputError
from gsmap.utils.extras import import_extra
from gsmap.utils.files import atomic_write
from gsmap.utils.words import format_count
from gsmap.visualization.bev_view import BEVPanel
from gsmap.visualization.camera_view import camera_views
from gsmap.visualization.figure import compose_figure, figure_to_rgb
from gsmap.visualization.style import MapStyle, track_colours


def write_film(path: str | Path, pictures: Iterable[np.ndarray], times_ns: Sequence[int]) -> None:
    """Write pictures as a film in H.264 (``.mp4``) that plays in real time.

    Args:
        path: File to write.
        pictures: RGB pictures of one size; an odd row or column at the end is dropped.
            (H, W, 3) uint8
        times_ns: Time of each picture in nanoseconds.

    Raises:
        RuntimeError: If ``av`` (PyAV) is missing.
    """
    av = import_extra("av", "viz")
    # The film has a constant rate, from the median period of the pictures. One picture alone, or
    # pictures of one time, are shown for half a second each.
    periods_ns = np.diff(times_ns)
    periods_ns = periods_ns[periods_ns > 0]  # drives that are joined may have equal times
    period_s = np.median(periods_ns) / 1e9 if len(periods_ns) else 0.5
    period_s = np.clip(period_s, 1 / 60, 10)
    rate = Fraction(1 / period_s).limit_denominator(100)  # pictures per second
    with atomic_write(path, "wb") as file, av.open(file, "w", format="mp4") as film:
        film.metadata["comment"] = "gsmap"
        stream = None
        for picture in pictures:
            if stream is None:  # the first picture sets the size of the film
                stream = film.add_stream("libx264", rate=rate, options={"crf": "20"})
                stream.pix_fmt = "yuv420p"  # every player supports it; sizes must be even
                height, width, _ = picture.shape
                stream.height = height // 2 * 2
                stream.width = width // 2 * 2
            pixels = _fit(picture, height=stream.height, width=stream.width)
            frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
            film.mux(stream.encode(frame))
        if stream is not None:
            film.mux(stream.encode())  # without a frame, it returns the frames that were delayed


def _fit(picture: np.ndarray, height: int, width: int) -> np.ndarray:
    """Shrink a picture if it is larger than a film, and pad it in white. (H, W, 3) uint8

    Pictures of one drive differ in size if its samples differ in their cameras. One odd row or
    column is cut off.
    """
    rows, columns, _ = picture.shape
    scale = min(1.0, height / (rows // 2 * 2), width / (columns // 2 * 2))
    if scale < 1:
        size = (int(columns * scale), int(rows * scale))
        picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    canvas = np.full((height, width, 3), 255, np.uint8)
    part = picture[:height, :width]
    canvas[: part.shape[0], : part.shape[1]] = part
    return canvas


def write_drive_film(
    path: str | Path,
    annotations: str | Path,
    results: Mapping[str, str | Path],
    scene: str | None = None,
    data_root: Path | None = None,
    score_thr: float = 0.4,
    images: bool = True,
    max_frames: int = 200,
    width_px: int = 1280,
) -> str:
    """Write a film of one drive.

    Each picture shows the cameras with the elements of the first result, the map of each result,
    and the ground truth. In the maps, elements of results with tracks (``track_id``) have one
    colour for each track. All other elements have the colours of their classes.

    Args:
        path: File to write.
        annotations: Annotation file.
        results: Result files by their names in the film, at least one.
        scene: Name of the drive; by default the first one of the annotation file.
        data_root: Folder that image paths are relative to; by default the folder of the annotation
            file.
        score_thr: Smallest score of a drawn prediction, in [0, 1].
        images: Whether to draw the cameras.
        max_frames: Largest number of frames, from the start of the drive.
        width_px: Width of the film in pixels.

    Returns:
        Text with the name of the drive, the number of frames and the path, and the numbers of
        elements whose class the annotation file lacks, or that have fewer than two points.

    Raises:
        FileNotFoundError: If a file does not exist.
        ValueError: If there is no result or no such scene, a file is malformed or does not fit the
            others, or an image is missing or damaged.
        RuntimeError: If ``av`` (PyAV) is missing.
    """
    if not results:
        raise InputError("results must name at least one result file.")
    if max_frames < 1:
        raise InputError(f"max_frames must be >= 1, got {max_frames}.")
    if not 0 <= score_thr <= 1:
        raise InputError(f"score_thr must be in [0, 1], got {score_thr}.")
    file = AnnotationFile(annotations)
    scenes = list(dict.fromkeys(file.column("scene")))  # without repetition, in their order
    if not scenes:
        raise InputError(f"{annotations} has no samples to show.")
    scene = scenes[0] if scene is None else scene
    if scene not in scenes:
        raise InputError(
            f"{annotations} has no scene {scene!r}: give one of its {len(scenes)}, such as "
            f"{scenes[0]!r}."
        )
    frames_by_result = {}
    for name, result_path in results.items():
        # One frame for each sample of the annotation file, in the order of scenes and times, with
        # the predictions and the ground truth. A result file that lacks a sample raises an error.
        result_frames = drive_frames(Path(result_path), file, file.meta.classes)
        frames_by_result[name] = [frame for frame in result_frames if frame.scene == scene]
    row_of_token = {token: row for row, token in enumerate(file.column("token"))}
    # All results have equal samples in equal order, so the first one gives the rows of the samples.
    first_frames = next(iter(frames_by_result.values()))
    all_times_ns = file.column("timestamp_ns")
    rows = []
    times_ns = []
    for frame in first_frames[:max_frames]:
        row = row_of_token[frame.token]
        rows.append(row)
        times_ns.append(all_times_ns[row])
    root = Path(annotations).parent if data_root is None else data_root
    pictures = _draw_frames(
        file,
        rows=rows,
        frames_by_result=frames_by_result,
        root=root if images else None,
        score_thr=score_thr,
        width_px=width_px,
    )
    write_film(path, pictures, times_ns)
    text = f"{scene}, {format_count(len(rows), 'frame')}: {path}"
    return text + _omissions(frames_by_result.values(), num_frames=len(rows))


def _omissions(frames_of_results: Iterable[Sequence[DriveFrame]], num_frames: int) -> str:
    """Text with the numbers of predictions in the first frames that cannot be drawn, if any."""
    num_unknown = 0
    num_short = 0
    for frames in frames_of_results:
        for frame in frames[:num_frames]:
            is_known = frame.predictions.labels >= 0
            num_unknown += int((~is_known).sum())
            num_short += int((is_known & ~_has_length(frame)).sum())
    text = ""
    if num_unknown:
        text += f"; {format_count(num_unknown, 'element')} of other classes left out"
    if num_short:
        text += f"; {format_count(num_short, 'element')} of fewer than two points left out"
    return text


def _has_length(frame: DriveFrame) -> np.ndarray:
    """Whether each of the n predictions of a frame has at least two points. (n,)"""
    return np.array([len(line) > 1 for line in frame.predictions.polylines], dtype=bool)


def _draw_frames(
    file: AnnotationFile,
    rows: Sequence[int],
    frames_by_result: Mapping[str, Sequence[DriveFrame]],
    root: Path | None,
    score_thr: float,
    width_px: int,
) -> Iterator[np.ndarray]:
    """Draw the frames of a drive as RGB pictures. (H, W, 3) uint8 each

    Args:
        file: Annotation file.
        rows: Indices of the samples to draw in the annotation file, in the order of time.
        frames_by_result: Frames of the drive for each result, by the name of the result. The first
            frames belong to ``rows``; there may be more.
        root: Folder that image paths are relative to, or None to leave cameras out.
        score_thr: Smallest score of a drawn prediction, in [0, 1].
        width_px: Width of the pictures in pixels.
    """
    meta = file.meta
    style = MapStyle(meta.classes)
    start_ns = file[rows[0]].timestamp_ns
    for index, row in enumerate(rows):
        sample = file[row]
        panels = []
        for name, frames in frames_by_result.items():
            panels.append(_result_panel(name, frame=frames[index], score_thr=score_thr))
        elements_over_cameras = panels[0].elements  # of the first result
        first_frames = next(iter(frames_by_result.values()))  # all have the ground truth
        panels.append(BEVPanel("Ground truth", first_frames[index].truth))
        cameras = []
        if root is not None:
            cameras = camera_views(sample.cameras, root, sample.token)
        # Axes and ground plane of the annotation frame. The plane is needed to project elements
        # without heights to the images. In the frame of a sensor that is mounted with a tilt, the
        # ground is tilted, so the plane is computed from the mounting.
        view = frame_view(meta.frame, meta.ground_z_m).with_mounting(sample.ego_from_frame)
        seconds = (sample.timestamp_ns - start_ns) / 1e9
        figure = compose_figure(
            cameras,
            panels,
            grid=BEVGrid(meta.x_range, meta.y_range),
            view=view,
            style=style,
            camera_elements=elements_over_cameras,
            title=f"{sample.scene}, {seconds:.1f} s",
            width_px=width_px,
        )
        yield figure_to_rgb(figure)


def _result_panel(name: str, frame: DriveFrame, score_thr: float) -> BEVPanel:
    """Panel of the predictions of a result, coloured by track if they have tracks.

    Predictions with a score below ``score_thr``, of other classes, or of fewer than two points are
    left out.
    """
    is_drawn = frame.predictions.confidence >= score_thr
    is_drawn &= frame.predictions.labels >= 0  # -1: a class that the annotation file lacks
    is_drawn &= _has_length(frame)
    predictions = frame.predictions.select(is_drawn)
    if frame.track_ids is None:
        return BEVPanel(name, predictions)
    colours = track_colours(frame.track_ids[is_drawn])
    return BEVPanel(f"{name}, tracks", predictions, colours=colours)
