"""Lanelets of centre lines and of driven lanes, as the ``lanelet2`` package routes on them."""

import time
from dataclasses import replace

import numpy as np
import pytest
import shapely
from drive_cases import drive_of

from drivemaps.directed_lines import resample
from drivemaps.drive import Drive, DriveFrame, read_drive
from drivemaps.driven_lanes import _join_repeats, driven_lanes
from drivemaps.geodetic import MapOrigin
from drivemaps.lanelet2 import write_lanelet2
from drivemaps.lanelets import lane_graph, lane_graph_of
from drivemaps.merging import merge
from drivemaps.truth import true_map
from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.annotations.record import MapSample
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
    assert not any(graph.left(lanelet) or graph.right(lanelet) for lanelet in lanelets)
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


def borders_of_a_road(*gaps: tuple[float, float]) -> list[np.ndarray]:
    """Two lanes of 3.5 m and their kerbs along y = 0, open in the gaps of x.

    .. code-block:: text

        0 ==========      ========== 200    y =  5.25  kerb
        0 ----------      ---------- 200    y =  1.75  divider
        0 ==========      ========== 200    y = -1.75  kerb
    """
    edges = [0.0, *(x for gap in gaps for x in gap), 200.0]
    lines = []
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        for y in (5.25, 1.75, -1.75):
            lines.append(np.array([[start, y], [stop, y]]))
    return lines


def track(*points: tuple[float, float]) -> np.ndarray:
    """Positions at most 8 m apart along a line through points. (n, 2)"""
    line = shapely.LineString(points)
    return shapely.get_coordinates(line.segmentize(8.0))


def test_driven_lanes_lie_in_the_middle_of_two_borders(tmp_path) -> None:
    """The vehicle drives 0.6 m left of the middle, over a junction of 20 m without lines."""
    positions = track((0.0, 0.6), (200.0, 0.6))
    borders = borders_of_a_road((90.0, 110.0))
    found = driven_lanes([positions], borders)
    assert found.outside_m == pytest.approx(0.0)
    for line in found.centerlines:
        np.testing.assert_allclose(line[:, 1], 0.0, atol=1e-9)
    lanelets, following = routing(tmp_path / "road.osm", lane_graph(found.centerlines, borders))
    last = len(lanelets) - 1
    assert following == {number: {number + 1} - {last + 1} for number in range(last + 1)}
    for lanelet in lanelets:  # the junction is as wide as the lanes, 3.5 m
        assert [point.y for point in lanelet.leftBound] == pytest.approx(
            [1.75] * len(lanelet.leftBound), abs=0.01
        )
        assert [point.y for point in lanelet.rightBound] == pytest.approx(
            [-1.75] * len(lanelet.rightBound), abs=0.01
        )
        assert lanelet.leftBound[0].x < lanelet.leftBound[-1].x


def test_drives_that_are_joined_have_tracks_of_their_own() -> None:
    """One vehicle drives east; another one comes back beside it, at equal times or later."""
    borders = borders_of_a_road()
    elements = MapElements.from_polylines(borders, [1] * len(borders))
    ways = {"a": track((0.0, 0.0), (100.0, 0.0)), "b": track((104.0, 3.5), (4.0, 3.5))}
    for later_ns in (0, 10**12):
        samples = []
        for scene, positions in ways.items():
            for number, (x, y) in enumerate(positions):
                pose = np.eye(4)
                pose[:2, 3] = x, y
                time_ns = number * 10**9 + (later_ns if scene == "b" else 0)
                samples.append(MapSample(f"{scene}{number}", scene, "town", time_ns, [], pose))
        samples.sort(key=lambda sample: sample.timestamp_ns)
        frames = [DriveFrame(sample, MapElements.from_polylines()) for sample in samples]
        drive = Drive("town", CLASSES, (-15.0, 15.0), (-30.0, 30.0), frames)
        lanes = lane_graph_of(drive, elements)
        assert lanes.source == "of driven lanes (0 of 200 m are in no lane)"
        length_m = 0.0
        for lanelet in lanes.lanelets:
            assert np.ptp(lanelet.left[:, 1]) < 0.1  # no lanelet leads across the divider
            length_m += shapely.LineString(lanelet.left).length
        assert 150 < length_m <= 200  # without the pieces at the nodes


def test_a_lane_change_joins_no_lanes(tmp_path) -> None:
    """West on the lane at y = 3.5, then across the divider; the lanes are not connected."""
    positions = track((200.0, 3.5), (120.0, 3.5), (90.0, 0.0), (0.0, 0.0))
    borders = borders_of_a_road()
    found = driven_lanes([positions], borders)
    assert {np.median(line[:, 1]).round(1) for line in found.centerlines} == {3.5, 0.0}
    lanelets, following = routing(tmp_path / "change.osm", lane_graph(found.centerlines, borders))
    ahead = reached({0}, following)
    assert ahead != set(following)
    for number in ahead:  # the lane at y = 3.5 runs west
        assert lanelets[number].leftBound[0].y < 3.5 < lanelets[number].rightBound[0].y


@pytest.mark.parametrize(
    ("borders", "outside_m"),
    [
        ([], 200.0),
        (borders_of_a_road()[:3:2], 0.0),  # no divider: 7 m wide
        (borders_of_a_road((60.0, 140.0)), 80.0),  # too long for a junction
        (borders_of_a_road((0.0, 40.0)), 40.0),  # no lane before it
        (borders_of_a_road()[::3], 200.0),  # no right border
    ],
)
def test_tracks_without_borders_are_in_no_lane(borders, outside_m) -> None:
    found = driven_lanes([track((0.0, 0.0), (200.0, 0.0))], borders)
    assert found.driven_m == pytest.approx(200.0)
    assert found.outside_m == pytest.approx(outside_m, abs=4.0)  # two samples


def test_a_standing_vehicle_and_gaps_of_the_track_are_no_lanes() -> None:
    """The vehicle stands still at 50 m, and no frame lies between 80 and 140 m."""
    start = track((0.0, 0.0), (50.0, 0.0))
    standing = np.array([50.0, 0.0]) + 0.05 * np.array([[0, 0], [1, 1], [-1, 0], [0, -1]])
    rest = track((50.0, 0.0), (80.0, 0.0))
    later = track((140.0, 0.0), (200.0, 0.0))
    found = driven_lanes([np.concatenate([start, standing, rest, later])], borders_of_a_road())
    united = shapely.line_merge(shapely.MultiLineString(found.centerlines))
    np.testing.assert_allclose([line.bounds[::2] for line in united.geoms], [[0, 80], [140, 200]])
    assert not driven_lanes([standing], borders_of_a_road()).centerlines


SIDE_STREET = ((60.0, -80.0), (60.0, -22.0), (62.0, -15.0), (66.0, -11.0))


@pytest.mark.parametrize("lead", [(), SIDE_STREET])
def test_a_block_driven_twice_has_one_ring_of_lanelets(lead, tmp_path) -> None:
    """Round a block two and a half times; with a lead, from a side street into the ring."""
    corners = [(0.0, 0.0), (100.0, 0.0), (100.0, 60.0), (0.0, 60.0), (0.0, 0.0)]
    ring = shapely.Polygon(corners).buffer(10.0).exterior
    borders = []
    for aside_m in (-1.75, 1.75):
        border = shapely.Polygon(ring).buffer(aside_m).exterior
        borders.append(shapely.get_coordinates(border))
    once = shapely.get_coordinates(ring.segmentize(5.0))
    if lead:
        start = np.linalg.norm(once - [72.0, -10.0], axis=1).argmin()
        once = np.concatenate([once[start:-1], once[: start + 1]])
        if once[1, 0] < once[0, 0]:
            once = once[::-1]
        for x in (58.25, 61.75):
            borders.append(np.array([[x, -80.0], [x, -20.0]]))
    laps = [once[1:], once[1:], once[1:14]]
    positions = [track(*lead, tuple(once[0])), *laps] if lead else [once[:1], *laps]
    found = driven_lanes([np.concatenate(positions)], borders)
    assert found.driven_m > 2.1 * ring.length
    lanes = lane_graph(found.centerlines, borders)
    _, following = routing(tmp_path / "block.osm", lanes)
    assert all(len(others) == 1 for others in following.values())
    assert reached({0}, following) == set(following)
    length_m = sum(shapely.LineString(lane.left).length for lane in lanes.lanelets)
    assert length_m < 1.2 * ring.length + 80.0


def test_many_stretches_are_joined_in_linear_time() -> None:
    """Each stretch of nine points begins at the middle of the one before."""
    count = 20_000
    points = np.random.default_rng(0).random((10 * count, 2))
    firsts = 10 * np.arange(count)
    earlier_points = np.full(len(points), -1)
    earlier_points[firsts[1:]] = firsts[:-1] + 4
    start_s = time.process_time()
    lines = _join_repeats(points, [(first, first + 8) for first in firsts.tolist()], earlier_points)
    assert time.process_time() - start_s < 10.0  # a search of all stretches takes a minute
    assert len(lines) == 2 * count - 1
    np.testing.assert_array_equal(lines[2], points[[4, 11, 12, 13, 14]])
    np.testing.assert_array_equal(lines[-1], points[[-16, *range(-9, -1)]])


def test_borders_beside_a_wide_lane_are_too_far_for_its_bounds() -> None:
    """Between kerbs 7 m apart the vehicle keeps to the right, 1.75 m from its kerb."""
    borders = borders_of_a_road()[:3:2]
    lanes = lane_graph(
        driven_lanes([track((0.0, 0.0), (200.0, 0.0))], borders).centerlines, borders
    )
    np.testing.assert_allclose(lanes.left[:, 1], 1.75)
    np.testing.assert_allclose(lanes.right[:, 1], -1.75)


def test_driven_lanes_of_minicity_are_its_annotated_lanes(minicity_drive) -> None:
    """A vehicle on the annotated paths finds their lanes from dividers and boundaries alone."""
    elements = true_map(minicity_drive)
    borders = elements.select(elements.labels < 2).polylines
    driven_m = 0.0
    outside_m = 0.0
    for frame in minicity_drive.frames:
        for path in frame.elements.select(frame.elements.labels == 2).polylines:
            found = driven_lanes([resample(path)], borders)
            driven_m += found.driven_m
            outside_m += found.outside_m
            for centerline in found.centerlines:
                distances_m = shapely.distance(shapely.LineString(path), shapely.points(centerline))
                assert distances_m.max() < 0.5
    assert outside_m < 0.7 * driven_m  # paths that end in a junction are cut at it


def test_a_drive_without_centre_lines_has_driven_lanes(minicity_drive) -> None:
    """The drive of a model that predicts dividers and boundaries; the vehicle moves 80 m."""
    sample = minicity_drive.frames[0].sample
    frames = []
    for position in track((0.0, 0.0), (80.0, 0.0)):
        pose = np.eye(4)
        pose[:2, 3] = position
        moved = replace(sample, global_from_frame=pose)
        frames.append(DriveFrame(moved, MapElements.from_polylines()))
    drive = replace(minicity_drive, classes=CLASSES[:2], frames=frames)
    merged = MapElements.from_polylines(borders_of_a_road(), [1, 0, 1])
    lanes = lane_graph_of(drive, merged)
    assert lanes.source == "of driven lanes (0 of 80 m are in no lane)"
    assert len(lanes.lanelets) == 2
    nothing = lane_graph_of(drive, MapElements.from_polylines())
    assert nothing.source == "of driven lanes (80 of 80 m are in no lane)"
    assert not nothing.lanelets
