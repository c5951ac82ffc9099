"""Lanelets of centre lines, loaded by the ``lanelet2`` package with their routing graph."""

import numpy as np
import pytest
import shapely
from drive_cases import drive_of

from drivemaps.drive import Drive, DriveFrame, read_drive
from drivemaps.geodetic import MapOrigin
from drivemaps.lanelet2 import write_lanelet2
from drivemaps.lanelets import lane_graph, lane_graph_of
from drivemaps.merging import merge
from drivemaps.truth import true_map
from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.elements import elements_of_instances
from gsmap.structures.elements import MapElements
from mapdata.nuscenes.convert import NuScenesOptions, convert_nuscenes

ORIGIN = MapOrigin(48.26, 11.67)
CLASSES = ("divider", "boundary", "centerline")
BEND = np.stack([np.sin(np.linspace(0, 1.5, 12)), 1 - np.cos(np.linspace(0, 1.5, 12))], axis=1)


def fork() -> list[np.ndarray]:
    """A lane that goes straight on, one that leaves it to the left at x = 50, one that comes back.

    .. code-block:: text

                    / (65, 15)
        0 -------- 50 -------- 100     y = 0
        0 ==================== 100     y = 3.5, the opposite way
    """
    straight = np.array([[0.0, 0.0], [100.0, 0.0]])
    leaving = np.array([50.0, 0.0]) + 15.0 * BEND
    back = np.array([[100.0, 3.5], [0.0, 3.5]])
    return [straight, leaving, back]


def routing(path, lanes) -> tuple[list, dict[int, set[int]]]:
    """Write lanelets, load them, and return them with the positions of those that follow."""
    pytest.importorskip("pyproj", reason="pip install -e .[maps]")
    pytest.importorskip("lanelet2", reason="pip install lanelet2")
    import lanelet2.io
    import lanelet2.projection
    import lanelet2.routing
    import lanelet2.traffic_rules as rules

    write_lanelet2(path, MapElements.from_polylines(), CLASSES, ORIGIN, lanes, 30.0)
    origin = lanelet2.io.Origin(ORIGIN.latitude_deg, ORIGIN.longitude_deg)
    projector = lanelet2.projection.LocalCartesianProjector(origin)
    found, errors = lanelet2.io.loadRobust(str(path), projector)
    assert not list(errors)
    traffic = rules.create(rules.Locations.Germany, rules.Participants.Vehicle)
    graph = lanelet2.routing.RoutingGraph(found, traffic)
    lanelets = sorted(found.laneletLayer, key=lambda lanelet: lanelet.id)
    assert all(traffic.canPass(lanelet) for lanelet in lanelets)
    assert all(traffic.isOneWay(lanelet) for lanelet in lanelets)
    limits = [traffic.speedLimit(lanelet).speedLimit for lanelet in lanelets]
    assert limits == pytest.approx([30.0] * len(lanelets))  # km/h
    position = {lanelet.id: number for number, lanelet in enumerate(lanelets)}
    following = {
        number: {position[other.id] for other in graph.following(lanelet)}
        for number, lanelet in enumerate(lanelets)
    }
    return lanelets, following


def test_a_fork_has_two_lanelets_that_follow(tmp_path) -> None:
    lanes = lane_graph(fork(), [])
    lanelets, following = routing(tmp_path / "fork.osm", lanes)
    assert following == {0: {1, 2}, 1: set(), 2: set(), 3: set()}
    left = np.array([[p.x, p.y] for p in lanelets[0].leftBound])
    right = np.array([[p.x, p.y] for p in lanelets[0].rightBound])
    # the fork's places have the mean direction of the lanes that meet there
    np.testing.assert_allclose(left[:-1, 1], 1.75, atol=0.01)
    np.testing.assert_allclose(right[:-1, 1], -1.75, atol=0.01)
    assert lanelets[3].leftBound[0].y < 3.5 < lanelets[3].rightBound[0].y  # it runs west


def test_vertices_that_repeat_change_nothing() -> None:
    straight, leaving, back = fork()
    repeated = [np.repeat(straight, 2, axis=0), leaving[[0, 0, *range(1, 12)]], back]
    lanes = lane_graph([*repeated, np.zeros((3, 2))], [])
    expected = lane_graph([straight, leaving, back], [])
    np.testing.assert_array_equal(lanes.left, expected.left)
    for lane, other in zip(lanes.lanelets, expected.lanelets, strict=True):
        np.testing.assert_array_equal(lane.right, other.right)


def test_bounds_lie_on_the_borders_beside_a_lane(tmp_path) -> None:
    divider = np.array([[-5.0, 1.5], [105.0, 1.5]])
    kerb = np.array([[-5.0, -2.4], [105.0, -2.4]])
    lanes = lane_graph(fork()[:1], [divider, kerb])
    np.testing.assert_allclose(lanes.left[:, 1], 1.5)
    np.testing.assert_allclose(lanes.right[:, 1], -2.4)
    np.testing.assert_allclose(lanes.lanelets[0].left[:, 1], 1.5)
    aside = np.array([0.0, 5.0])
    far = lane_graph(fork()[:1], [divider + aside, kerb - aside])
    np.testing.assert_allclose(far.left[:, 1], 1.75)


def test_the_direction_is_that_of_the_frames() -> None:
    """The map's line runs west; in both frames the lane runs east, in one a piece of it."""
    whole = np.array([[0.0, 0.0], [40.0, 0.0]])
    sample = drive_of().frames[0].sample
    frames = [
        DriveFrame(sample, MapElements.from_polylines([piece], [2]))
        for piece in (whole, whole + np.array([20.0, 0.0]))
    ]
    drive = Drive("scene", CLASSES, (-30.0, 30.0), (-15.0, 15.0), frames)
    merged = MapElements.from_polylines([np.array([[60.0, 0.0], [0.0, 0.0]])], [2])
    lanes = lane_graph_of(drive, merged)
    np.testing.assert_allclose(lanes.left, [[0, 1.75], [60, 1.75]])
    without = Drive("scene", CLASSES[:2], (-30.0, 30.0), (-15.0, 15.0), frames)
    assert not lane_graph_of(without, merged).lanelets


def test_short_parts_between_forks_stay_in_the_true_map() -> None:
    """Two lanes leave a straight one at x = 50 and 51.5; no gap is left between them.

    .. code-block:: text

                   / /
        0 --------- - -------- 100
    """
    paths = [np.array([[0.0, 0.0], [100.0, 0.0]])]
    for start in (50.0, 51.5):
        leaving = np.array([start, 0.0]) + 15.0 * BEND
        paths.append(np.concatenate([[[0.0, 0.0]], leaving]))
    sample = drive_of().frames[0].sample
    frame = DriveFrame(sample, MapElements.from_polylines(paths, [2] * len(paths)))
    drive = Drive("scene", CLASSES, (-30.0, 30.0), (-15.0, 15.0), [frame])
    united = shapely.MultiLineString(true_map(drive).polylines)
    missing = shapely.LineString(paths[0]).difference(united.buffer(0.01))
    assert missing.length < 0.1


@pytest.fixture(scope="module")
def minicity_drive(minicity_root, tmp_path_factory) -> Drive:
    """The ground truth of a drive through MiniCity, with centre lines of lanes and junctions."""
    folder = tmp_path_factory.mktemp("centerlines")
    classes = (*CLASSES, "ped_crossing")
    options = NuScenesOptions(
        minicity_root, "v1.0-trainval", dataset="minicity", classes=classes, out_dir=folder
    )
    convert_nuscenes(options)
    file = AnnotationFile(folder / "gsmap_minicity_train.arrow")
    maps = {sample.token: elements_of_instances(sample.instances or []) for sample in file}
    return read_drive(file, file.column("scene")[:1], maps)


def lanelets_at(centres: list, point: np.ndarray, heading: np.ndarray) -> set[int]:
    """Positions of the lanelets whose middle passes within 1.5 m of a point, in its direction."""
    found = set()
    for number, centre in enumerate(centres):
        along = centre.project(shapely.Point(point))
        around = np.clip([along - 1.0, along + 1.0], 0.0, centre.length)
        before, after = (np.array(centre.interpolate(distance).coords[0]) for distance in around)
        alike = (after - before) @ heading > 0.5 * np.linalg.norm(after - before)
        if alike and centre.distance(shapely.Point(point)) <= 1.5:
            found.add(number)
    return found


def reached(start: set[int], following: dict[int, set[int]]) -> set[int]:
    """Positions of the lanelets that can be driven to."""
    known, newest = set(start), set(start)
    while newest:
        newest = {other for number in newest for other in following[number]} - known
        known |= newest
    return known


@pytest.mark.parametrize("make_map", [true_map, merge])
def test_every_annotated_path_of_minicity_can_be_driven(minicity_drive, make_map, tmp_path):
    """A centre line is a path through lanes: its first lanelet leads to its last one."""
    lanes = lane_graph_of(minicity_drive, make_map(minicity_drive))
    lanelets, following = routing(tmp_path / "city.osm", lanes)
    assert len(lanelets) == len(lanes.lanelets) > 5
    assert max(map(len, following.values())) >= 2  # a junction
    centres = [
        shapely.LineString([[point.x, point.y] for point in lanelet.centerline])
        for lanelet in lanelets
    ]
    paths = 0
    for frame in minicity_drive.frames:
        elements = frame.elements
        for path in elements.select(elements.labels == 2).polylines:
            if shapely.LineString(path).length < 10:
                continue
            paths += 1
            first, last = path[1] - path[0], path[-1] - path[-2]
            start = lanelets_at(centres, path[0], first / np.linalg.norm(first))
            end = lanelets_at(centres, path[-1], last / np.linalg.norm(last))
            assert reached(start, following) & end, path
    assert paths > 5
