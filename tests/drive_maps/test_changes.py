"""Changes between an old map and later drives, drawn by hand."""

import numpy as np
import pytest
from drive_cases import CLASSES, X_RANGE, Y_RANGE, curve, drive_of, street

from drivemaps.change import MIN_VIEWS, Pass, Shift
from drivemaps.changes import find_changes, summarize_changes
from drivemaps.drive import Drive, DriveFrame
from drivemaps.merging import merge
from gsmap.datasets.annotations.record import MapSample
from gsmap.structures.elements import MapElements


def map_of(rows):
    return MapElements.from_polylines([line for _, line in rows], [label for label, _ in rows])


@pytest.fixture(scope="module")
def passes():
    """Three noisy drives along the street."""
    drives = [drive_of(0.2, True, seed) for seed in range(3)]
    return [Pass(drive, merge(drive)) for drive in drives]


def test_noise_is_no_change(passes):
    for some in (passes[:1], passes):
        assert find_changes(map_of(street()), some).changes == []


def test_a_moved_line_and_a_moved_area_have_their_distance_within_its_error(passes):
    rows = street()
    rows[2] = (0, curve(0.0))  # the divider is at -1 m
    rows[5] = (1, rows[5][1] + [1.2, 0.9])
    found = find_changes(map_of(rows), passes).changes
    assert [(change.kind, CLASSES[change.label]) for change in found] == [
        ("moved", "divider"),
        ("moved", "ped_crossing"),
    ]
    for change, distance_m in zip(found, (1.0, 1.5), strict=True):
        assert 0.02 < change.moved_std_m < 0.1  # 0.2 m of noise in more than ten frames
        assert abs(change.moved_m - distance_m) < 3 * change.moved_std_m
        assert (change.num_passes, change.passes_in_view) == (3, 3)
    radius = np.linalg.norm(found[0].line - [300, 700], axis=1)
    assert np.abs(radius - 199).mean() < 0.15


def test_the_number_of_passes_decides(passes):
    """A crossing that no drive of three sees is gone; that one or two see is there."""
    gone = map_of([*street(), (1, street()[5][1] + curve(0.0)[15] - curve(0.0)[30])])
    rows = dict(enumerate(street()))
    without = []
    for one_pass in passes:
        elements = one_pass.elements
        without.append(Pass(one_pass.drive, elements.select(elements.labels != 1)))
    for num_missing in (3, 2, 1):
        mixed = [*without[:num_missing], *passes[num_missing:]]
        found = find_changes(map_of(list(rows.values())), mixed).changes
        assert [change.kind for change in found] == ["removed"] * (num_missing == 3)
        for change in found:
            assert (change.num_passes, change.passes_in_view) == (num_missing, 3)
    (change,) = find_changes(gone, passes).changes
    assert (change.kind, change.label, change.num_passes) == ("removed", 1, 3)


def straight_drive(lines, labels, positions):
    """Frames at (0, y), which see lines in the global frame cut to their range."""
    frames = []
    for number, y in enumerate(positions):
        pose = np.eye(4)
        pose[1, 3] = y
        sample = MapSample(
            f"t{number}", "scene", "town", number, [], pose, ego_from_frame=np.eye(4)
        )
        pieces = [np.clip(line, [-99, y - 30], [99, y + 30]) for line in lines]
        elements = MapElements.from_polylines(pieces, labels, [0.9] * len(pieces))
        frames.append(DriveFrame(sample, elements))
    return Drive("scene", CLASSES, X_RANGE, Y_RANGE, frames)


UP = np.array([[0.0, 0.0], [0.0, 100.0]])


def beside(x, share=1.0):
    """A part of the line from its start, at another x."""
    return UP * [1, share] + np.array([x, 0])


@pytest.mark.parametrize(
    ("old", "expected"),
    [
        ([UP], []),
        ([UP, beside(4)], [("removed", 4.0, 0, 100)]),
        ([beside(0, 0.5)], [("added", 0.0, 52, 80)]),  # then ground far from the old map
        ([beside(0.4)], []),  # below half a metre
        ([beside(-0.9)], [("moved", 0.0, 0, 100)]),
        ([beside(2)], [("removed", 2.0, 0, 100), ("added", 0.0, 0, 100)]),
        ([UP, beside(4, 0.04)], [("removed", 4.0, 0, 4)]),  # a whole short line
        ([UP, beside(20)], []),  # not in range
    ],
)
def test_lines_of_a_straight_road(old, expected):
    """A drive at x = 0 from y = 0 to 100, and an old map with lines beside it."""
    drive = straight_drive([UP], [0], np.arange(0.0, 101.0, 4.0))
    one_pass = Pass(drive, map_of([(0, UP)]))
    found = find_changes(map_of([(0, line) for line in old]), [one_pass])
    values = []
    for change in found.changes:
        x, y = change.line.T
        values.append((change.kind, round(float(x.mean()), 2), y.min().round(), y.max().round()))
        if change.kind == "moved":
            assert change.moved_m == pytest.approx(0.9)
            # 0.2 m and 2 percent of the distance, in about 13 of 26 frames
            assert 0.03 < change.moved_std_m < 0.12
    assert values == expected
    not_in_view = {"divider": 1} if abs(old[-1][0, 0]) == 20 else {}
    assert found.num_not_in_view == not_in_view


@pytest.mark.parametrize(("width", "height"), [(14, 4), (16, 4), (14, 70)])
def test_a_removed_area_is_as_sure_if_no_frame_has_it_whole_in_range(width, height):
    """A frame has 15 m to each side and 60 m along the road in range."""
    drive = straight_drive([UP], [0], np.arange(0.0, 101.0, 4.0))
    corners = np.array([[-1, 0], [1, 0], [1, 1], [-1, 1], [-1, 0]])
    area = corners * [width, height] + [0, 15]
    one_pass = Pass(drive, map_of([(0, UP)]))
    (change,) = find_changes(map_of([(0, UP), (1, area)]), [one_pass]).changes
    assert (change.kind, change.passes_in_view) == ("removed", 1)
    assert change.confidence == pytest.approx(0.87, abs=0.03)  # n / (n + 2) of 11 to 17 frames


def test_few_views_and_new_ground_are_no_changes():
    for num_frames in (MIN_VIEWS - 1, MIN_VIEWS):
        drive = straight_drive([UP], [0], np.arange(num_frames) * 0.1)
        one_pass = Pass(drive, map_of([(0, beside(0, 0.3))]))
        found = find_changes(map_of([(0, beside(0, 0.3)), (0, beside(5, 0.3))]), [one_pass])
        assert [change.kind for change in found.changes] == ["removed"] * (num_frames == MIN_VIEWS)
    drive = straight_drive([UP], [0], np.arange(0.0, 101.0, 4.0))
    found = find_changes(map_of([(0, beside(100))]), [Pass(drive, map_of([(0, UP)]))])
    assert summarize_changes(found) == (
        "0 removed, 0 added, 0 moved (not compared: 1 divider on new ground; 1 divider of the old "
        "map not in view)"
    )
    small = np.array([[0, 50], [0.9, 50], [0.9, 51], [0, 51], [0, 50]])
    areas = [(1, small), (1, small[:2]), (1, small * 2 - [0, 50])]
    found = find_changes(map_of([(0, UP), *areas]), [Pass(drive, map_of([(0, UP)]))])
    assert summarize_changes(found) == (
        "1 removed, 0 added, 0 moved (not compared: 2 ped_crossing of the old map below 1 m2)"
    )
    empty = find_changes(MapElements.from_polylines(), [Pass(drive, map_of([(0, UP)]))])
    assert empty.changes == []


def test_long_straight_lines_and_wide_areas_in_view_are_compared():
    """Their vertices lie far from the drive, or from the old map."""
    drive = straight_drive([UP], [0], np.arange(0.0, 39.0, 2.0))
    long = UP * 5 - [0, 200]
    ring = np.array([[-1, 15], [1, 15], [1, 19], [-1, 19], [-1, 15]])
    rows = [
        (0, long),
        (0, np.add(long, [3, 0])),
        (1, ring * [16, 1]),
        (1, ring * [20, 1]),
        (0, UP + 150),
    ]
    found = find_changes(map_of(rows), [Pass(drive, map_of([(0, long)]))])
    assert summarize_changes(found) == (
        "2 removed, 0 added, 0 moved (not compared: 1 divider, 1 ped_crossing of the old map not "
        "in view)"  # the last divider, and a crossing with 70 percent of its outline in view
    )
    new = find_changes(map_of([(0, beside(0, 0.2))]), [Pass(drive, map_of([(0, long)]))])
    assert summarize_changes(new) == "0 removed, 2 added, 0 moved"  # before and after it
    lines_only = find_changes(map_of([(0, long)]), [Pass(drive, map_of([(0, long), (1, ring)]))])
    text = "0 removed, 1 added, 0 moved; the old map has no ped_crossing at all, so all of its 1"
    assert summarize_changes(lines_only) == f"{text} count as added"


def test_the_error_of_a_shift_by_hand():
    """Weights 3 : 1; the mean of 1 and 2 m is 1.25 m."""
    shift = Shift.of_frames(np.array([1.0, 2.0]), np.array([0.01, 0.03]), np.array([3.0, 1.0]))
    assert shift.mean_m == pytest.approx(1.25)
    by_scatter = (0.75**2 * 0.25**2 + 0.25**2 * 0.75**2) ** 0.5
    assert shift.std_m == pytest.approx(by_scatter)
    sure = Shift.of_frames(np.array([1.0, 1.0]), np.array([0.01, 0.03]), np.array([3.0, 1.0]))
    assert sure.std_m == pytest.approx((0.75**2 * 0.01 + 0.25**2 * 0.03) ** 0.5)
    assert sure.exceeds(1.0)
    assert not Shift(1.0, 0.4).exceeds(0.5)
    assert Shift(0.5, 0.1).probability(0.5) == pytest.approx(0.5)


def test_a_doubtful_element_of_the_old_map_is_a_doubtful_change():
    """A line that is gone, and one that moved, of which the old map was half sure."""
    drive = straight_drive([UP], [0], np.arange(0.0, 101.0, 4.0))
    one_pass = Pass(drive, map_of([(0, UP)]))
    confidences = []
    for score in (1.0, 0.5):
        old = MapElements.from_polylines([beside(0.9), beside(5)], [0, 0], [score, score])
        found = find_changes(old, [one_pass]).changes
        assert [change.kind for change in found] == ["removed", "moved"]
        confidences.append([change.confidence for change in found])
    np.testing.assert_allclose(confidences[1], np.array(confidences[0]) / 2)


def test_only_the_part_of_an_old_map_near_the_drives_is_compared():
    """Lines of 14,000 km would be sampled every metre."""
    drive = straight_drive([UP], [0], np.arange(0.0, 101.0, 4.0))
    one_pass = Pass(drive, map_of([(0, UP)]))
    far = np.array([[1e6, 0.0], [1e7, 9e6]])
    found = find_changes(map_of([(0, UP), (0, far)]), [one_pass])
    assert found.changes == []
    assert found.num_not_in_view == {"divider": 1}
    near = np.array([[0.0, 0.0], [1e7, 1e7]])
    with pytest.raises(ValueError, match="14142 km of lines near the drives: at most 1000 km"):
        find_changes(map_of([(0, UP), (0, near)]), [one_pass])
