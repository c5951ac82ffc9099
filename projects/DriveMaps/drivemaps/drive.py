"""Drives: sequences of frames with their maps, predicted or annotated, in the global frame."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from scipy.spatial import cKDTree

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.annotations.record import MapSample
from gsmap.datasets.scene_places import scenes_of_several_places
from gsmap.structures.elements import BoolArray, FloatArray, IntArray, MapElements
from gsmap.utils.errors import InputError

MIN_LENGTH_M = 2.0
"""Smallest length in metres of a line in the map of a drive. `line_merging` drops shorter lines."""
MIN_AREA_M2 = 1.0
"""Smallest size in square metres of an area in the map. `area_merging` drops smaller areas."""
SIMPLIFY_M = 0.02
"""Tolerance of simplification in metres: dropped vertices lie at most this far from the line."""
_SLACK_M = 1e-3  # added to `Drive.reach_m`, covers the rounding of transforms


@dataclass(frozen=True, eq=False)
class DriveFrame:
    """One sample of a drive with its map.

    Args:
        sample: Sensors and poses. Its ``global_from_frame`` (4, 4) is the transform from the
            annotation frame, the frame of the vehicle or LiDAR, to the global frame, in metres.
        elements: Map of the sample, (x, y) in metres in the global frame.
    """

    sample: MapSample
    elements: MapElements

    @property
    def origin(self) -> FloatArray:
        """Origin of the annotation frame, in metres in the global frame. (2,)"""
        return self.sample.global_from_frame[:2, 3]

    @property
    def rotation(self) -> FloatArray:
        """Rotation by yaw from the annotation frame to the global frame. (2, 2)"""
        # The first column of the transform is the x axis of the frame. Its projection to the plane
        # is shorter than 1 if the vehicle is tilted.
        cos, sin = self.sample.global_from_frame[:2, 0]
        return np.array([[cos, -sin], [sin, cos]]) / np.hypot(cos, sin)

    @property
    def yaw_rad(self) -> float:
        """Angle of ``rotation`` in radians, anticlockwise."""
        return float(np.arctan2(self.rotation[1, 0], self.rotation[0, 0]))

    def predictions_of(self, label: int) -> IntArray:
        """Find the predictions of a class. Those with a score of 0 have no weight and are left out.

        Args:
            label: Index of the class.

        Returns:
            Indices of the elements. (n,)
        """
        elements = self.elements
        return np.flatnonzero((elements.labels == label) & (elements.confidence > 0.0))

    def to_global(self, points: FloatArray) -> FloatArray:
        """Transform points from the annotation frame to the global frame, in the plane.

        Args:
            points: Points (x, y) in metres. (..., 2)

        Returns:
            Points in the global frame. (..., 2)
        """
        return points @ self.rotation.T + self.origin

    def to_frame(self, points: FloatArray) -> FloatArray:
        """Transform points from the global frame to the annotation frame, in the plane.

        Args:
            points: Points (x, y) in metres. (..., 2)

        Returns:
            Points in the annotation frame. (..., 2)
        """
        # The inverse of a rotation is its transpose, so `.T` of `to_global` is left out here.
        return (points - self.origin) @ self.rotation


@dataclass(frozen=True, eq=False)
class Drive:
    """Frames of one scene, or of several scenes that lie in one place.

    Args:
        name: Name of the scene or of the place.
        classes: Class names in label order.
        x_range: Smallest and largest x of the range of a frame, in metres in its annotation frame.
        y_range: Smallest and largest y of the range of a frame, in metres in its annotation frame.
        frames: Frames in the order of time.
    """

    name: str
    classes: tuple[str, ...]
    x_range: tuple[float, float]
    y_range: tuple[float, float]
    frames: Sequence[DriveFrame]

    def in_range(self, frame: DriveFrame, points: FloatArray) -> BoolArray:
        """Mask of the points in the range of a frame.

        Args:
            frame: Frame of the drive.
            points: Points in metres in the global frame. (M, 2)

        Returns:
            True for points in the range. (M,)
        """
        low, high = np.array([self.x_range, self.y_range]).T  # corners (x, y) of the range
        frame_points = frame.to_frame(points)
        return ((frame_points >= low) & (frame_points <= high)).all(axis=1)

    @property
    def scenes(self) -> list[str]:
        """Names of the scenes of the frames, sorted."""
        return sorted({frame.sample.scene for frame in self.frames})

    @property
    def reach_m(self) -> float:
        """Largest distance in metres from the origin of a frame to a point of its range."""
        farthest_x = np.abs(self.x_range).max()
        farthest_y = np.abs(self.y_range).max()
        return float(np.hypot(farthest_x, farthest_y)) + _SLACK_M

    def count_frames_in_range(self, points: FloatArray) -> IntArray:
        """Count, for each point, the frames whose range contains it.

        Args:
            points: Points in metres in the global frame. (M, 2)

        Returns:
            Number of frames. (M,)
        """
        counts = np.zeros(len(points), np.int64)
        # The tree finds the points near a frame, so only these points are transformed to the frame.
        tree = cKDTree(points)
        for frame in self.frames:
            near = tree.query_ball_point(frame.origin, self.reach_m)
            counts[near] += self.in_range(frame, points[near])
        return counts

    def nearby(self, frame: DriveFrame, elements: MapElements) -> MapElements:
        """Select the elements whose bounding boxes come near the range of a frame.

        Args:
            frame: Frame of the drive.
            elements: Elements in the global frame.

        Returns:
            All elements with a vertex or an edge in the range, and possibly some others.
        """
        # `reduceat` reduces the points from each offset to the next one. For an empty element, it
        # would return a point of the next element, so empty elements are left out.
        nonempty = np.flatnonzero(elements.num_points)
        if not len(nonempty):  # there is no vertex at all, and `reduceat` needs one
            return elements
        starts = elements.offsets[nonempty]
        points = elements.points[:, :2]
        low = np.minimum.reduceat(points, starts)  # (N, 2)
        high = np.maximum.reduceat(points, starts)  # (N, 2)
        # An element is near if its bounding box overlaps the square around the frame on both axes.
        starts_before = low <= frame.origin + self.reach_m  # (N, 2)
        ends_after = high >= frame.origin - self.reach_m  # (N, 2)
        is_near = (starts_before & ends_after).all(axis=1)
        return elements.select(nonempty[is_near])

    def footprint(self, frame: DriveFrame) -> shapely.Polygon:
        """Range of a frame as a rectangle in the global frame."""
        x0, x1 = self.x_range
        y0, y1 = self.y_range
        corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
        return shapely.Polygon(frame.to_global(corners))


def require_scenes(annotations: AnnotationFile, scenes: Iterable[str]) -> None:
    """Raise ValueError if an annotation file lacks one of the scenes."""
    known_scenes = set(annotations.column("scene"))
    for scene in scenes:
        if scene not in known_scenes:
            some_scenes = sorted(known_scenes)[:5]
            raise InputError(f"{annotations.path} has no scene {scene!r}, but {some_scenes} ...")


def places_of(annotations: AnnotationFile, scenes: Iterable[str]) -> dict[str, str]:
    """Place of each scene, the ``map_name`` of its samples.

    Args:
        annotations: Annotation file with the samples of the scenes.
        scenes: Names of the scenes.

    Returns:
        Places by the name of the scene, in the order of the scenes; an unknown place is empty.

    Raises:
        ValueError: If the file lacks a scene, or the samples of a scene lie in several places.
    """
    places = dict.fromkeys(scenes, "")
    require_scenes(annotations, places)
    pairs = []
    columns = (annotations.column("scene"), annotations.column("map_name"))
    for scene, place in zip(*columns, strict=True):
        if place and scene in places:
            pairs.append((scene, place))
    for scene, names in scenes_of_several_places(pairs).items():
        raise InputError(
            f"the samples of scene {scene!r} lie in several places, {names} (map_name), and a "
            "scene is one drive: give each drive a scene name that no other drive has, or one "
            "map_name to samples of one global frame."
        )
    places.update(pairs)
    return places


def read_drive(
    annotations: AnnotationFile,
    scenes: Sequence[str],
    maps: Mapping[str, MapElements],
    name: str = "",
) -> Drive:
    """Create the drive of a scene, or join the drives of several scenes.

    Args:
        annotations: Annotation file with the samples of the scenes.
        scenes: Names of the scenes, which must share one global frame.
        maps: Map of each sample in its annotation frame, by token. Samples without a map are left
            out.
        name: Name of the drive; empty for the name of the first scene.

    Returns:
        Frames of all scenes in the order of time, with their maps in the global frame. Heights of
        the maps are dropped.

    Raises:
        ValueError: If the file lacks a scene, the samples of a scene lie in several places, or no
            sample of a scene has a map.
    """
    places_of(annotations, scenes)  # raises an error for a scene of several places
    samples_of_scene: dict[str, list[MapSample]] = {scene: [] for scene in scenes}
    scene_of_row = annotations.column("scene")  # name of the scene of each sample of the file
    for row, scene in enumerate(scene_of_row):
        if scene in samples_of_scene:
            sample = annotations[row]  # reads the sample from the file
            if sample.token in maps:
                samples_of_scene[scene].append(sample)
    samples = []
    for scene, samples_of_one in samples_of_scene.items():
        if not samples_of_one:
            raise InputError(
                f"no sample of scene {scene!r} has results: give the results of "
                f"{annotations.path}, or choose other drives with --scene."
            )
        samples += samples_of_one
    samples.sort(key=lambda sample: sample.timestamp_ns)
    frames = []
    for sample in samples:
        elements = maps[sample.token].with_coordinates(2)
        global_elements = elements.to_frame(sample.global_from_frame)
        frames.append(DriveFrame(sample, global_elements))
    meta = annotations.meta
    return Drive(
        name or scenes[0],
        classes=meta.classes,
        x_range=meta.x_range,
        y_range=meta.y_range,
        frames=frames,
    )


def drive_map(rows: Iterable[tuple[int, FloatArray, float]], scored: bool = True) -> MapElements:
    """Create the map of a drive: simplify its elements, and sort them.

    Args:
        rows: Label, vertices and score of each element. The vertices are in metres in the global
            frame. (n, >= 2)
        scored: Whether the map keeps the scores.

    Returns:
        The N elements, ordered by class, then by falling score, then by the first vertex.
    """
    simple_rows = []
    for label, line, score in rows:
        simple_line = shapely.LineString(line[:, :2]).simplify(SIMPLIFY_M)
        simple_rows.append((label, shapely.get_coordinates(simple_line), score))
    simple_rows.sort(key=_order_in_map)
    polylines = []
    labels = []
    scores = []
    for label, line, score in simple_rows:
        polylines.append(line)
        labels.append(label)
        scores.append(score)
    map_scores = scores if scored else None
    return MapElements.from_polylines(polylines, labels=labels, scores=map_scores)


def _order_in_map(row: tuple[int, FloatArray, float]) -> tuple[float, ...]:
    """Key that sorts by class, then by falling score, then by the first vertex."""
    label, line, score = row
    # Rounded, so that differences in the last digits do not change the order.
    x, y = np.round(line[0], 6)
    return label, -round(score, 9), x, y
