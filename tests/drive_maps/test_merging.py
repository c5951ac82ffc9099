from dataclasses import replace

import numpy as np
import pytest
import shapely
from drive_cases import CLASSES, X_RANGE, Y_RANGE, drive_of, street

from drivemaps import line_matching
from drivemaps.area_merging import merge_areas
from drivemaps.change import Pass
from drivemaps.changes import find_changes
from drivemaps.config import MergeConfig
from drivemaps.drive import Drive, DriveFrame
from drivemaps.merging import confident, merge, suppress
from drivemaps.scoring import cut_to_frame, map_figures, near_and_total_m
from drivemaps.stitching import stitch
from drivemaps.truth import polygons_of, true_map
from gsmap.datasets.annotations.record import MapSample
from gsmap.structures.elements import MapElements


def seen_street(drive):
    """The street within the drive's range, as lines by label."""
    seen = shapely.union_all([drive.footprint(frame) for frame in drive.frames])
    return [(label, shapely.intersection(shapely.LineString(p), seen)) for label, p in street()]


def test_samples_cuts_of_one_map_are_put_together_exactly():
    drive = drive_of()
    found = true_map(drive)
    expected = seen_street(drive)
    assert sorted(found.labels.tolist()) == sorted(label for label, _ in expected)
    for label, line in expected:
        distances = [
            shapely.hausdorff_distance(line, shapely.LineString(p))
            for p in found.select(found.labels == label).polylines
        ]
        assert min(distances) < 0.05  # 2 cm of simplification and the rounding of the grid
    rings = [p for p in found.polylines if np.array_equal(p[0], p[-1])]
    assert len(rings) == 2  # the crossing and the island


@pytest.mark.parametrize("make", [merge, true_map])
def test_ground_truth_fed_as_predictions_gives_1(make):
    drive = drive_of()
    true = true_map(drive)
    found = make(drive)
    found = replace(found, scores=np.ones(len(found)))  # predictions have scores
    figures = map_figures([found], [true], [drive])
    for name, of_class in figures.items():
        assert set(of_class) == {*CLASSES, "mean"}
        # a vertex a metre from an end or corner may be missing, 150 m of line are there
        assert min(of_class.values()) > (0.99 if "@" in name else 1 - 1e-9), name


def test_an_area_of_exactly_the_smallest_size_is_kept():
    frame = drive_of().frames[0]
    place = np.round(frame.sample.global_from_frame[:2, 3])  # its areas have no rounding
    for width_m, kept in ((1.0, 1), (0.99, 0)):
        square = place + np.array([[0, 0], [width_m, 0], [width_m, 1], [0, 1], [0, 0]])
        assert len(polygons_of([square])) == kept
        elements = MapElements.from_polylines([square], [1], [0.9])
        drive = replace(drive_of(), frames=[replace(frame, elements=elements)])
        assert len(merge_areas(drive, 1, MergeConfig(min_area_confidence=0.0))) == kept


def still_drive(lines, label, scores, num_frames=1):
    """Frames at the origin, each with elements of one class."""
    sample = replace(drive_of().frames[0].sample, global_from_frame=np.eye(4))
    elements = MapElements.from_polylines(lines, [label] * len(lines), scores)
    return replace(drive_of(), frames=[DriveFrame(sample, elements)] * num_frames)


@pytest.mark.parametrize("y", [0.0, -7.0])  # -7: over the vehicle
@pytest.mark.parametrize(("first", "area_m2"), [([[-2, 5], [2, 5]], 16), ([[2, 5], [-2, 5]], 8)])
def test_a_crossing_with_an_edge_that_runs_back_is_merged_without_the_edge(first, area_m2, y):
    """A square and a bow of two triangles, with an edge of 2 m there and back."""
    ring = np.array([*first, [2, 9], [2, 11], [2, 9], [-2, 9], first[0]])
    found = merge(still_drive([np.add(ring, [0, y])], 1, [0.9]))
    assert sum(shapely.Polygon(line).area for line in found.polylines) == pytest.approx(area_m2)
    assert found.scores.tolist() == pytest.approx([0.9] * len(found))


def test_merging_beats_suppression_on_noisy_frames():
    drive = drive_of(noise_m=0.3, scored=True)
    true = true_map(drive_of())
    merged, suppressed = (map_figures([make(drive)], [true], [drive]) for make in (merge, suppress))
    assert merged["AP"]["mean"] == 1.0 > suppressed["AP"]["mean"]
    # the mean of a dozen frames errs by 0.3 m / sqrt(12)
    assert merged["accuracy@0.5"]["mean"] > 0.98 > suppressed["accuracy@0.5"]["mean"]
    assert merged["completeness@0.5"]["mean"] > 0.95


def test_merging_is_deterministic_and_leaves_no_duplicates():
    drive = drive_of(noise_m=0.3, scored=True)
    first, second = merge(drive), merge(drive)
    np.testing.assert_array_equal(first.points, second.points)
    assert len(first) == len(street())
    assert first.points.dtype == np.float64
    assert ((first.scores > 0.4) & (first.scores <= 0.9)).all()


def test_certain_gaussians_outweigh_uncertain_ones():
    """One line at x = 0 in a third of the frames, sigma 0.1; at x = 0.8 in the rest, sigma 2."""
    drive = drive_of()
    frames = []
    for number, frame in enumerate(drive.frames):
        certain = number % 3 == 0
        line = np.array([[0.0 if certain else 0.8, y] for y in np.linspace(-20, 20, 20)])
        elements = MapElements.from_polylines(
            [line],
            [0],
            [0.9],
            scales=[np.full((20, 2), 0.1 if certain else 2.0)],
            rotations=[np.zeros(20)],
        )
        still = replace(frame.sample, global_from_frame=np.eye(4))
        frames.append(DriveFrame(still, elements))
    drive = replace(drive, frames=frames)
    weighted, plain = (merge(drive, MergeConfig(gaussians=g)).points[:, 0] for g in (True, False))
    assert abs(weighted).max() < 0.2
    assert abs(plain - 0.8 * 2 / 3).max() < 0.05


def test_variance_across_a_line_is_that_of_the_gaussians_other_axis():
    elements = MapElements.from_polylines(
        [np.array([[0.0, 0.0], [0.0, 1.0]])],
        [0],
        [1.0],
        scales=[np.array([[0.3, 0.1], [0.3, 0.1]])],
        rotations=[np.array([np.pi / 2, 0.0])],
    )
    sample = replace(drive_of().frames[0].sample, global_from_frame=np.eye(4))
    found = MergeConfig().variances(DriveFrame(sample, elements))
    np.testing.assert_allclose(found, [0.1**2, 0.3**2 + 0.02**2], atol=1e-12)


def test_what_few_frames_see_is_left_out():
    drive = drive_of(noise_m=0.1, scored=True)
    ghost = drive.frames[10].to_global(np.array([[-4.0, -20.0], [-4.0, 20.0]]))
    elements = drive.frames[10].elements
    more = MapElements.from_polylines(
        [*elements.polylines, ghost], [*elements.labels, 0], [*elements.scores, 0.95]
    )
    frames = list(drive.frames)
    frames[10] = replace(frames[10], elements=more)
    assert len(merge(replace(drive, frames=frames))) == len(street())
    assert len(confident(drive, 0.99).frames[0].elements) == 0


def test_no_predictions_make_an_empty_map_that_can_be_scored():
    drive = confident(drive_of(noise_m=0.1, scored=True), 0.99)
    assert len(merge(drive)) == len(suppress(drive)) == 0
    figures = map_figures([merge(drive)], [true_map(drive_of())], [drive])
    assert figures["AP"]["mean"] == figures["completeness@1.5"]["mean"] == 0.0
    assert figures["accuracy@1.5"] == {}


@pytest.mark.filterwarnings("error")  # of a division by 0
@pytest.mark.parametrize("label", [0, 1])
@pytest.mark.parametrize("scores", [[0.0], [0.0, 0.9]])
def test_predictions_with_a_score_of_0_have_no_weight(label, scores):
    """A line or crossing that is surely not there, and one 6 m beside it."""
    ring = np.array([[-2.0, -2], [2, -2], [2, 2], [-2, 2], [-2, -2]])
    shape = ring if label == 1 else np.array([[0.0, -10], [0, 10]])
    shapes = [shape, np.add(shape, [6, 0])][: len(scores)]
    drive = still_drive(shapes, label, scores, num_frames=6)
    found = merge(drive, MergeConfig(min_confidence=0.0, min_area_confidence=0.0))
    assert found.scores.tolist() == pytest.approx(scores[1:])
    old = MapElements.from_polylines([np.add(shape, [1, 0])], [label])
    map_of_shape = MapElements.from_polylines([shape], [label], [0.9])
    assert find_changes(old, [Pass(drive, map_of_shape)]).changes == []


def test_suppression_keeps_the_best_of_what_overlaps():
    drive = drive_of()
    lines = [np.array([[x, -20.0], [x, 20.0]]) for x in (0.0, 0.6, 3.0)]
    elements = MapElements.from_polylines(lines, [0, 0, 0], [0.5, 0.8, 0.6])
    drive = replace(drive, frames=[replace(drive.frames[0], elements=elements)])
    assert suppress(drive).scores.tolist() == [0.8, 0.6]


def test_lengths_near_the_other_map():
    """Ten metres of line beside eight of the other, 0.7 m away."""
    one = MapElements.from_polylines([np.array([[0.0, 0.0], [10.0, 0.0]])], [0])
    other = MapElements.from_polylines([np.array([[0.0, 0.7], [8.0, 0.7]])], [0])
    assert near_and_total_m(one, other, 0, 0.5).tolist() == [0.0, 10.0]
    near, total = near_and_total_m(one, other, 0, 1.0)
    assert near == pytest.approx(8.0 + np.sqrt(1.0 - 0.49), abs=0.01)
    assert total == 10.0


def test_ends_that_meet_are_joined_the_straightest_first():
    """Three lines from one point: ahead, to the left, and the one that comes to it."""
    comes = np.array([[-20.0, 0.0], [0.0, 0.0]])
    ahead = np.array([[20.0, 0.5], [0.5, 0.0]])
    left = np.array([[0.5, 0.1], [10.0, 10.0]])
    found = sorted(stitch([left, comes, ahead]), key=len)
    np.testing.assert_array_equal(found[0], left)
    np.testing.assert_array_equal(found[1][[0, -1]], [[-20.0, 0.0], [20.0, 0.5]])


def test_a_line_that_meets_itself_becomes_a_ring_and_a_turn_back_is_not_joined():
    angles = np.linspace(0.0, 6.1, 40)
    ring = 10.0 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    pieces = [ring[:15], ring[:13:-1]]
    (closed,) = stitch(pieces)
    np.testing.assert_array_equal(closed[0], closed[-1])
    side_by_side = [np.array([[0.0, y], [10.0, y]]) for y in (0.0, 1.0)]
    assert len(stitch(side_by_side)) == 2


@pytest.mark.parametrize(("side", "closes"), [(2.0, True), (1.6, False)])
def test_a_line_of_10_m_whose_ends_meet_becomes_a_ring(side: float, closes: bool):
    """A hexagon but for a tenth of one side: 11.8 m, 9.8 m before the last vertex; and 9.4 m."""
    angles = np.arange(6) * np.pi / 3
    corners = side * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    start = corners[0] + 0.9 * (corners[5] - corners[0])
    long = np.array([[100.0, 0.0], [150.0, 0.0]])  # its length is nothing to the others
    _, line = stitch([long, np.concatenate([start[None], corners])])
    assert np.array_equal(line[0], line[-1]) == closes


def test_lines_a_metre_apart_or_less_are_suppressed():
    drive = drive_of()
    lines = [np.array([[x, 0.0], [x, 20.0]]) for x in (0.0, 0.9, 1.5)]
    elements = MapElements.from_polylines(lines, [0] * 3, [0.9, 0.8, 0.7])
    drive = replace(drive, frames=[DriveFrame(drive.frames[0].sample, elements)])
    assert suppress(drive).scores.tolist() == [0.9, 0.7]


def straight(count: int) -> Drive:
    """A drive along a straight street, with what each of its frames sees of it."""
    x0, x1 = X_RANGE
    frames = []
    for number in range(count):
        pose = np.eye(4)
        pose[0, 3] = 10.0 * number
        sample = MapSample(f"t{number}", "scene", "town", number * 10**9, [], pose)
        lines = [np.array([[x0, y], [x1, y]]) for y in (-3.0, 3.0)]
        area = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 2.0], [0.0, 2.0], [0.0, 0.0]])
        empty = DriveFrame(sample, MapElements.from_polylines())
        own = [empty.to_global(line) for line in [*lines, area]]
        labels = [CLASSES.index(name) for name in ("divider", "boundary", "ped_crossing")]
        frames.append(DriveFrame(sample, MapElements.from_polylines(own, labels, [0.9] * 3)))
    return Drive("scene", CLASSES, X_RANGE, Y_RANGE, frames)


def test_the_work_grows_with_the_frames_of_a_drive(monkeypatch):
    """Points that are moved into frames: twice the frames, twice the points."""
    moved = []
    to_frame = DriveFrame.to_frame

    def counted(self, points):
        moved.append(np.size(points))
        return to_frame(self, points)

    monkeypatch.setattr(DriveFrame, "to_frame", counted)
    work = []
    for count in (40, 80):
        drive = straight(count)
        pieces = [DriveFrame(f.sample, f.elements) for f in drive.frames]
        apart = MapElements.from_polylines(
            [line for f in pieces for line in f.elements.polylines],
            [label for f in pieces for label in f.elements.labels],
            [0.9] * 3 * count,
        )
        moved.clear()
        merge(drive)
        for frame in drive.frames:
            cut_to_frame(apart, drive, frame)
        work.append(sum(moved))
    assert work[1] < 2.3 * work[0]


def test_duplicates_within_a_frame_change_nothing():
    drive = drive_of(0.1, scored=True)
    frames = []
    for frame in drive.frames:
        elements = frame.elements
        beside = np.array([0.3, 0.4])  # 0.5 m away
        doubles = [line + beside for line in elements.polylines]
        polylines = [*elements.polylines, *doubles]
        labels = [*elements.labels, *elements.labels]
        scores = [*elements.confidence, *(elements.confidence / 2)]
        both = MapElements.from_polylines(polylines, labels, scores)
        is_area = both.labels == CLASSES.index("ped_crossing")
        is_double = np.arange(len(both)) >= len(elements)
        frames.append(replace(frame, elements=both.select(~(is_area & is_double))))
    expected = merge(drive)
    found = merge(replace(drive, frames=frames))
    np.testing.assert_array_equal(found.points, expected.points)
    np.testing.assert_array_equal(found.labels, expected.labels)


def test_lines_that_no_drive_has_are_refused_before_they_are_merged():
    drive = drive_of()
    frame = drive.frames[0]
    fine = np.stack([np.arange(50_000) % 2, np.linspace(-30.0, 30.0, 50_000)], axis=1)
    # five of nine run along another one, and are left out
    long = [np.array([[0.0, -49_500.0], [float(i), 49_500.0]]) for i in range(9)]
    for lines, reason in (
        ([fine], "lie too close together"),
        (long, r"has 396 km of 'divider' in 1 frames: at most 250 km and 5 km a frame"),
    ):
        elements = MapElements.from_polylines(lines, [0] * len(lines), [0.9] * len(lines))
        one_frame = replace(drive, frames=[replace(frame, elements=elements)])
        with pytest.raises(ValueError, match=reason):
            merge(one_frame)


def test_what_a_frame_sees_and_how_often_is_that_of_all_elements_looked_at():
    drive = drive_of(0.1, scored=True)
    found = suppress(drive)
    points = found.points + np.random.default_rng(0).normal(0, 20, found.points.shape)
    expected = np.sum([drive.in_range(frame, points) for frame in drive.frames], axis=0)
    np.testing.assert_array_equal(drive.count_frames_in_range(points), expected)
    low, high = np.array([drive.x_range, drive.y_range]).T
    for frame in drive.frames:
        near = drive.nearby(frame, found)
        kept = {line.tobytes() for line in near.polylines}
        for line in found.polylines:
            local = frame.to_frame(line)
            meets = shapely.LineString(local).intersects(shapely.box(*low, *high))
            assert line.tobytes() in kept or not meets


@pytest.mark.parametrize("at_once", [7, 100])
def test_crossings_that_are_looked_for_in_parts_are_the_same(at_once, monkeypatch):
    drive = drive_of(0.3, scored=True)
    whole = merge(drive)
    monkeypatch.setattr(line_matching, "_CHUNK_SIZE", at_once)
    parts = merge(drive)
    np.testing.assert_array_equal(whole.points, parts.points)
    np.testing.assert_array_equal(whole.scores, parts.scores)
