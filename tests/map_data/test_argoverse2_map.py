"""Local maps of Argoverse 2 logs: by hand on a straight road, and against reference outputs."""

import json

import numpy as np
import pytest
import shapely
from argoverse2_road import bow_tie, crossing, pose, road_map, write_map
from av2.geometry.geometry import quat_to_mat

from mapdata.argoverse2.map import COMPAT_MODES, DEFAULT_RULES, Argoverse2Map
from mapdata.argoverse2.rules import clip_polygons, drop_duplicates, merge_until_stable
from mapdata.crossings import cut_rings, merge_parallel
from mapdata.local_map import LocalPatch, rings_of


@pytest.fixture
def road(tmp_path) -> Argoverse2Map:
    write_map(tmp_path)
    return Argoverse2Map.from_log(tmp_path)


def xy_sets(lines: list[np.ndarray]) -> set[frozenset]:
    """Lines without direction or start: the set of their vertices, to the centimetre."""
    return {frozenset(map(tuple, np.round(line[:, :2], 2).tolist())) for line in lines}


def test_straight_road_by_the_default_rules(road):
    elements = road.extract(pose())
    # The line between the neighbouring lanes, once, through both pieces; not the outer paint.
    assert xy_sets(elements["divider"]) == {frozenset({(-30.0, 0.0), (30.0, 0.0)})}
    ring = frozenset({(10.0, -5.0), (13.0, -5.0), (13.0, 5.0), (10.0, 5.0)})
    assert xy_sets(elements["ped_crossing"]) == {ring}
    np.testing.assert_array_equal(elements["ped_crossing"][0][0], elements["ped_crossing"][0][-1])
    # The outline stops 0.2 m before the patch does.
    assert xy_sets(elements["boundary"]) == {
        frozenset({(-29.8, 5.0), (29.8, 5.0)}),
        frozenset({(-29.8, -5.0), (29.8, -5.0)}),
    }


def test_straight_road_by_the_rules_of_maptr(road):
    elements = road.extract(pose(), compat="maptr")
    # All paint, the doubly mapped middle once.
    assert xy_sets(elements["divider"]) == {
        frozenset({(-30.0, 0.0), (0.0, 0.0), (30.0, 0.0)}),
        frozenset({(-30.0, -4.0), (0.0, -4.0), (30.0, -4.0)}),
    }


def test_centerlines_run_through_both_lane_pieces(road):
    lines = road.extract(pose(), ["centerline"])["centerline"]
    assert xy_sets(lines) == {
        frozenset({(-30.0, 2.0), (30.0, 2.0)}),
        frozenset({(-30.0, -2.0), (30.0, -2.0)}),
    }
    assert all(line[0, 0] < line[-1, 0] for line in lines)  # in the direction of travel


def test_the_patch_turns_with_the_vehicle(road):
    """Heading +y at x = 20: the road runs along the vehicle's y, the crossing lies to its left."""
    elements = road.extract(pose(x=20.0, yaw_rad=np.pi / 2))
    assert xy_sets(elements["divider"]) == {frozenset({(0.0, -15.0), (0.0, 15.0)})}
    ring = frozenset({(-5.0, 10.0), (-5.0, 7.0), (5.0, 7.0), (5.0, 10.0)})
    assert xy_sets(elements["ped_crossing"]) == {ring}


def test_a_crossing_cut_by_the_patch_is_open_or_closed_by_the_rules(road):
    """At x = -18 the crossing (10 .. 13) reaches from 28 to 31 in the vehicle's frame."""
    (open_line,) = road.extract(pose(x=-18.0))["ped_crossing"]
    expected = np.array([[29.8, 5.0], [28.0, 5.0], [28.0, -5.0], [29.8, -5.0]])
    assert shapely.LineString(open_line[:, :2]).equals_exact(shapely.LineString(expected), 1e-9)
    (ring,) = road.extract(pose(x=-18.0), compat="maptr")["ped_crossing"]
    assert xy_sets([ring]) == {frozenset({(28.0, 5.0), (28.0, -5.0), (30.0, -5.0), (30.0, 5.0)})}
    np.testing.assert_array_equal(ring[0], ring[-1])


def test_corners_of_the_patch_get_the_height_of_their_area():
    """A slope of 10 % with a hole, around a patch of 60 x 30 m that is turned by 30 degrees."""
    turned = pose()
    cos, sin = np.cos(np.pi / 6), np.sin(np.pi / 6)
    turned[:2, :2] = [[cos, -sin], [sin, cos]]
    patch = LocalPatch(turned, x_range=(-30, 30), y_range=(-15, 15))
    centre = turned[:3, 3]

    def square(half_m: float) -> np.ndarray:
        x, y = half_m * np.array([[-1, 1, 1, -1], [-1, -1, 1, 1]])
        return centre + np.stack([x, y, 0.1 * x], axis=1)

    slope = shapely.Polygon(square(80), holes=[square(5)])
    flat = shapely.force_2d(slope)
    (piece, flat_piece), _ = clip_polygons(np.array([slope, flat]), patch)
    corners = shapely.get_coordinates(piece.exterior, include_z=True)
    assert len(corners) == 5
    x = corners[:, :2] @ turned[0, :2]  # east of the centre
    np.testing.assert_allclose(corners[:, 2], 0.1 * x, atol=1e-9)
    assert len(piece.interiors) == 1
    hole = shapely.get_coordinates(piece.interiors[0], include_z=True)
    np.testing.assert_allclose(hole[:, 2], 0.1 * (hole[:, :2] @ turned[0, :2]), atol=1e-9)
    np.testing.assert_allclose(shapely.get_coordinates(flat_piece.exterior), corners[:, :2])


def test_heights_are_relative_to_the_vehicle_and_follow_its_pitch(road):
    elements = road.extract(pose())
    assert max(abs(line[:, 2]).max() for line in elements["boundary"]) == 0.0
    pitched, angle = pose(), np.radians(3.0)
    pitched[:3, :3] = [
        [np.cos(angle), 0, np.sin(angle)],
        [0, 1, 0],
        [-np.sin(angle), 0, np.cos(angle)],
    ]
    (divider,) = road.extract(pitched)["divider"]
    ahead = divider[divider[:, 0].argmax()]  # nose down: the road ahead rises
    np.testing.assert_allclose(ahead, [30 * np.cos(angle), 0, 30 * np.sin(angle)], atol=1e-9)


def test_invalid_polygons_take_no_part_and_are_counted(tmp_path):
    write_map(tmp_path, road_map(bow_tie(30), crossing(31, (10.0, 13.0), (-5.0, 5.0))))
    road = Argoverse2Map.from_log(tmp_path)
    assert road.invalid_counts == {"lane segments": 0, "crossings": 1, "drivable areas": 0}
    assert len(road.extract(pose())["ped_crossing"]) == 1


def test_off_the_map_there_is_nothing(road):
    far = pose(x=500.0)
    for compat in COMPAT_MODES:
        elements = road.extract(far, ("divider", "ped_crossing", "boundary", "centerline"), compat)
        assert elements == {"divider": [], "ped_crossing": [], "boundary": [], "centerline": []}


def test_bad_arguments_are_named(road, tmp_path):
    with pytest.raises(ValueError, match=r"compat must be one of .* got 'maptr3'"):
        road.extract(pose(), compat="maptr3")
    with pytest.raises(ValueError, match=r"got \['lamp'\]"):
        road.extract(pose(), ["lamp"])
    with pytest.raises(ValueError, match="4 x 4"):
        road.extract(np.full((4, 4), np.nan))
    with pytest.raises(FileNotFoundError, match="log_map_archive"):
        Argoverse2Map.from_log(tmp_path / "elsewhere")


def test_of_two_lines_that_cover_each_other_the_first_stays():
    lines = shapely.linestrings(
        [[[0, 0], [20, 0]], [[0.5, 0.05], [20, 0.05]], [[0, 0], [15, 0]], [[0, 0], [0, 20]]]
    )
    np.testing.assert_array_equal(drop_duplicates(lines), lines[[0, 2, 3]])


def test_parallel_crossings_that_touch_are_one_element():
    """Two strips side by side, one across their end, one parallel but away."""
    boxes = shapely.box([0, 3, 0, 20], [0, 0, 10, 0], [3, 6, 10, 23], [10, 10, 13, 10])
    merged = merge_parallel(boxes, np.arange(4))
    np.testing.assert_allclose(
        shapely.bounds(merged), shapely.bounds([shapely.box(0, 0, 6, 10), *boxes[2:]])
    )


def test_antiparallel_crossings_are_one_element():
    """The straight long sides of two overlapping strips: run through up, then down."""
    strip = np.array([[0, 0], [2, 1], [3, 5], [2, 9], [0, 10]], float)
    turned = np.array([5, 10]) - strip
    merged = merge_parallel(shapely.polygons([strip, turned]), np.arange(2))
    assert shapely.bounds(merged).tolist() == [[0, 0, 5, 10]]


def test_pieces_of_a_ring_are_joined_across_its_start():
    ring = np.array([shapely.LinearRing([(0, 0), (20, 0), (20, 8), (0, 8)])])
    lines, owner = cut_rings(ring, shapely.box(-10, -10, 10, 10))
    assert owner.tolist() == [0]
    assert shapely.get_coordinates(lines).tolist() == [[10, 8], [0, 8], [0, 0], [10, 0]]


def test_holes_turn_the_other_way_than_the_exterior():
    square = shapely.box(0, 0, 9, 9).difference(shapely.box(3, 3, 6, 6))
    rings = rings_of(np.array([square]))
    assert shapely.is_ccw(rings).tolist() == [False, True]


def test_lines_are_split_where_they_cross_and_doubles_vanish():
    r"""
        | c
    a --+-- b,  a-b given twice
        | d
    """
    lines = shapely.linestrings([[[-9, 0], [9, 0]], [[9, 0], [-9, 0]], [[0, -9], [0, 9]]])
    merged = merge_until_stable(lines)
    assert sorted(shapely.length(merged).tolist()) == [9.0] * 4


def test_equal_points_stay_equal_in_the_vehicles_frame():
    """A batched matrix product may round the same point differently from row to row."""
    turned = pose(yaw_rad=0.7)
    points = np.random.default_rng(0).normal(scale=50, size=(37, 3)) + turned[:3, 3]
    lines = shapely.linestrings(np.stack([points, points[::-1]]))
    patch = LocalPatch(turned, (-30.0, 30.0), (-15.0, 15.0))
    forward, backward = shapely.get_coordinates(patch.to_frame(lines)).reshape(2, 37, 2)
    np.testing.assert_array_equal(forward, backward[::-1])


def golden_frames(path) -> list[dict]:
    if not path.is_file():
        pytest.skip(f"no reference output {path.name}")
    return json.loads(path.read_text())["frames"][::3]


@pytest.fixture(scope="session")
def reference_logs(shared_dir, golden_dir):
    """Maps of the reference's logs and its poses by (log, row)."""
    poses = {}
    for frame in json.loads((golden_dir / "data" / "E5_A.json").read_text())["frames"]:
        matrix = np.eye(4)
        matrix[:3, :3] = quat_to_mat(np.array(frame["city_SE3_ego"]["q_wxyz"]))
        matrix[:3, 3] = frame["city_SE3_ego"]["t"]
        poses[frame["log"], frame["row"]] = matrix
    root = shared_dir / "av2" / "sensor" / "val"
    return {log: Argoverse2Map.from_log(root / log) for log in {log for log, _ in poses}}, poses


def assert_same_elements(found: list[np.ndarray], expected: list[list], dim: int, where: tuple):
    """Each line of 0.1 m or more has its one twin within 5 mm."""
    lines = [shapely.LineString(np.asarray(p)[:, :2]) for p in found]
    free = [
        (line, np.asarray(p)) for line, p in zip(lines, found, strict=True) if line.length > 0.1
    ]
    for points in expected:
        points = np.asarray(points)[:, :dim]
        line = shapely.LineString(points[:, :2])
        if line.length < 0.1:
            continue
        gaps = [shapely.hausdorff_distance(line, other, densify=0.2) for other, _ in free]
        assert gaps, where
        assert min(gaps) < 0.005, where
        _, twin = free.pop(int(np.argmin(gaps)))
        if dim == 3:  # every vertex is found, heights included
            nearest = np.linalg.norm(points[:, None] - twin[None], axis=-1).min(1)
            assert nearest.max() < 0.005, where
    assert not free, where


@pytest.mark.parametrize(
    ("file", "compat", "classes", "dim"),
    [
        ("E5_A.json", DEFAULT_RULES, ("divider", "ped_crossing", "boundary"), 3),
        ("E5_A_centerline.json", DEFAULT_RULES, ("centerline",), 3),
        ("E5b_A.json", "maptr", ("divider", "ped_crossing", "boundary"), 2),
    ],
)
def test_elements_of_real_logs_equal_the_reference(
    golden_dir, reference_logs, file, compat, classes, dim
):
    frames = golden_frames(golden_dir / "data" / file)
    maps, poses = reference_logs
    compared = 0
    for frame in frames:
        key = frame["log"], frame["row"]
        elements = maps[frame["log"]].extract(poses[key], classes, compat)
        for label, name in enumerate(classes):
            if "vectors" in frame:
                expected = [v["pts"] for v in frame["vectors"] if v["label"] == label]
            else:
                expected = frame[name]
            assert_same_elements(elements[name], expected, dim, (*key, name))
            compared += len(expected)
    assert compared > 1000
