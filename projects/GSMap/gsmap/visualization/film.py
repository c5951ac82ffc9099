"""Films (H.264), and a drive as one: cameras, the maps of result files side by side, the truth."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.evaluation.analysis.consistency import DriveFrame
from gsmap.evaluation.analysis.drive_files import drive_frames
from gsmap.structures.frames import frame_view
from gsmap.structures.grid import BEVGrid
from gsmap.utils.errors import InputError
from gsmap.utils.extras import import_extra
from gsmap.utils.files import atomic_write
from gsmap.utils.words import counted
from gsmap.visualization.bev_view import BEVPanel
from gsmap.visualization.camera_view import camera_views
from gsmap.visualization.figure import compose_figure, figure_to_rgb
from gsmap.visualization.style import MapStyle, track_colours


def write_film(path: str | Path, pictures: Iterable[np.ndarray], times_ns: Sequence[int]) -> None:
    """Write pictures as a film (``.mp4``) in H.264, as fast as they were taken.

    Args:
        path: File to write.
        pictures: RGB, all of one size; an odd row or column at the end is left out. (H, W, 3) uint8
        times_ns: When they were taken, in nanoseconds.

    Raises:
        RuntimeError: If ``av`` (PyAV) is missing.
    """
    av = import_extra("av", "viz")
    period_s = np.median(np.diff(times_ns)) / 1e9 if len(times_ns) > 1 else 0.5
    rate = Fraction(1 / np.clip(period_s, 1 / 60, 10)).limit_denominator(100)
    with atomic_write(path, "wb") as file, av.open(file, "w", format="mp4") as film:
        stream = None
        for picture in pictures:
            if stream is None:
                stream = film.add_stream("libx264", rate=rate, options={"crf": "20"})
                stream.pix_fmt = "yuv420p"  # what every player takes, of even sizes
                stream.height, stream.width = (size // 2 * 2 for size in picture.shape[:2])
            shown = np.ascontiguousarray(picture[: stream.height, : stream.width])
            film.mux(stream.encode(av.VideoFrame.from_ndarray(shown, format="rgb24")))
        if stream is not None:
            film.mux(stream.encode())


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
    """Write a film of one drive: cameras with the first result, each result, the ground truth.

    Elements of results with tracks (``track_id``) have their track's colour, so that one that stays
    the same keeps it; without tracks, and in the cameras, colours are those of classes.

    Args:
        path: File to write.
        annotations: Annotation file.
        results: Result files by the names that the film gives them.
        scene: The drive; the annotation file's first one by default.
        data_root: Folder that image paths start from; the annotation file's by default.
        score_thr: Smallest score of a drawn prediction, in [0, 1].
        images: Whether to show the cameras.
        max_frames: Largest number of frames, from the start of the drive.
        width_px: Width of the film.

    Returns:
        What was written, in words.

    Raises:
        FileNotFoundError: If a file does not exist.
        ValueError: If there is no such scene, or a file is malformed or does not fit the others.
        RuntimeError: If ``av`` (PyAV) is missing.
    """
    file = AnnotationFile(annotations)
    scenes = list(dict.fromkeys(file.column("scene")))
    scene = scenes[0] if scene is None else scene
    if scene not in scenes:
        raise InputError(
            f"{annotations} has no scene {scene!r}: give one of its {len(scenes)}, such as "
            f"{scenes[0]!r}."
        )
    drives = {
        name: [f for f in drive_frames(Path(file_), file, file.meta.classes) if f.scene == scene]
        for name, file_ in results.items()
    }
    rows = {token: row for row, token in enumerate(file.column("token"))}
    first = next(iter(drives.values()))[:max_frames]
    chosen = [rows[frame.token] for frame in first]
    times_ns = [file.column("timestamp_ns")[row] for row in chosen]
    root = Path(annotations).parent if data_root is None else data_root
    pictures = _pictures(file, chosen, drives, root if images else None, score_thr, width_px)
    write_film(path, pictures, times_ns)
    return f"{scene}, {counted(len(chosen), 'frame')}: {path}"


def _pictures(
    file: AnnotationFile,
    rows: Sequence[int],
    drives: Mapping[str, Sequence[DriveFrame]],
    root: Path | None,
    score_thr: float,
    width_px: int,
) -> Iterator[np.ndarray]:
    """Draw the frames of a drive one after another. (H, W, 3) each"""
    meta, style = file.meta, MapStyle(file.meta.classes)
    start_ns = file[rows[0]].timestamp_ns
    for number, row in enumerate(rows):
        sample = file[row]
        panels = [_panel(name, frames[number], score_thr) for name, frames in drives.items()]
        truth = next(iter(drives.values()))[number].truth
        seconds = (sample.timestamp_ns - start_ns) / 1e9
        figure = compose_figure(
            camera_views(sample.cameras, root, sample.token) if root is not None else [],
            [*panels, BEVPanel("Ground truth", truth)],
            BEVGrid(meta.x_range, meta.y_range),
            frame_view(meta.frame, meta.ground_z_m).with_mounting(sample.ego_from_frame),
            style,
            panels[0].elements,
            f"{sample.scene}, {seconds:.1f} s",
            width_px,
        )
        yield figure_to_rgb(figure)


def _panel(name: str, frame: DriveFrame, score_thr: float) -> BEVPanel:
    """Show a result's predictions, coloured by track if they have any."""
    kept = frame.predictions.confidence >= score_thr
    found = frame.predictions.select(kept)
    if frame.track_ids is None:
        return BEVPanel(name, found)
    return BEVPanel(f"{name}, tracks", found, colours=track_colours(frame.track_ids[kept]))
