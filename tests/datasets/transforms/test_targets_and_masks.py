"""Targets and masks: values worked by hand, and the reference's own."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from gsmap.datasets.annotations.record import MapInstance
from gsmap.datasets.transforms.map_targets import map_targets
from gsmap.datasets.transforms.masks import MakeBEVMask, MakePVMask

RANGES = {"x_range": (-15.0, 15.0), "y_range": (-30.0, 30.0)}


def golden_instances(golden_dir: Path, name: str) -> list[MapInstance]:
    elements = json.loads((golden_dir / "models/gt_A.json").read_text())["sets"][name]
    return [MapInstance(e["label"], np.array(e["pts"])) for e in elements]


def test_targets_of_a_line_that_leaves_the_range():
    line = MapInstance(2, np.array([[14.0, 0], [18.0, 0]]))
    targets = map_targets([line], 3, **RANGES)
    np.testing.assert_allclose(targets.pts[0, :, 0], [14, 15, 15])
    np.testing.assert_allclose(targets.pts_shifts[0, 1, :, 0], [15, 15, 14])
    np.testing.assert_allclose(targets.boxes[0], [14, 0, 15, 0])
    assert targets.labels_3d.tolist() == [2]
    assert targets.closed.tolist() == [False]


def test_no_element_gives_empty_targets_of_the_right_shape():
    targets = map_targets([], 20, **RANGES)
    assert targets.pts.shape == (0, 20, 2)
    assert targets.pts_shifts.shape == (0, 19, 20, 2)
    assert targets.boxes.shape == (0, 4)
    assert targets.polylines.shape == (0, 2, 2)
    assert targets.polylines.dtype == torch.float32
    assert targets.labels_3d.dtype == torch.int64
    assert targets.closed.dtype == torch.bool


def test_polylines_keep_every_vertex_clamped_and_padded_by_their_last():
    short = MapInstance(0, np.array([[0.0, 0, 7], [20, 40, 7]]))
    longer = MapInstance(2, np.array([[0.0, 0, 7], [1, 0, 7], [1, 2, 7]]))
    polylines = map_targets([short, longer], 20, **RANGES, dim=3).polylines
    assert polylines.dtype == torch.float32
    assert polylines.tolist() == [[[0, 0], [15, 30], [15, 30]], [[0, 0], [1, 0], [1, 2]]]


def test_three_coordinates_are_kept_or_refused():
    line = MapInstance(0, np.array([[0.0, 0, 1], [0, 2, 3]]))
    np.testing.assert_allclose(map_targets([line], 3, **RANGES, dim=3).pts[0, 1], [0, 1, 2])
    assert map_targets([line], 3, **RANGES).pts.shape == (1, 3, 2)
    flat = MapInstance(0, np.zeros((2, 2)))
    with pytest.raises(ValueError, match="dim 3"):
        map_targets([flat], 3, **RANGES, dim=3)


def test_points_of_three_coordinates_lie_above_those_of_two():
    """A ramp: 3 m along the plane while climbing 4, then 1 m on the level. Lengths are the plane's.

    Points at 0, 1, ... 4 m of the plane, as without height; along the ramp they would be elsewhere.
    """
    ramp = MapInstance(0, np.array([[0.0, 0, 0], [3, 0, 4], [3, 1, 4]]))
    ring = MapInstance(1, np.array([[0.0, 0, 0], [4, 0, 3], [4, 4, 3], [0, 0, 0]]))
    flat, high = (map_targets([ramp, ring], 5, **RANGES, dim=dim) for dim in (2, 3))
    np.testing.assert_allclose(high.pts[0, :, 2], [0, 4 / 3, 8 / 3, 4, 4], rtol=1e-6)
    for name in ("labels_3d", "boxes", "closed", "polylines"):
        assert torch.equal(high[name], flat[name])
    for name in ("pts", "pts_shifts"):
        torch.testing.assert_close(high[name][..., :2], flat[name])
    assert high.closed.tolist() == [False, True]


def test_heights_are_not_clamped():
    line = MapInstance(2, np.array([[14.0, 0, 0], [18.0, 0, 40]]))
    targets = map_targets([line], 3, **RANGES, dim=3)
    np.testing.assert_allclose(targets.pts[0], [[14, 0, 0], [15, 0, 20], [15, 0, 40]])


@pytest.mark.parametrize("name", ["closed", "many"])
def test_targets_equal_the_reference(golden_dir: Path, name: str):
    wanted = np.load(golden_dir / f"models/maptr_loss_{name}_A.npz")
    targets = map_targets(golden_instances(golden_dir, name), 20, **RANGES)
    # the tolerance that the reference states for its targets
    np.testing.assert_allclose(targets.pts, wanted["gt_fixed_pts"], atol=1e-4)
    np.testing.assert_allclose(targets.pts_shifts, wanted["gt_shift_pts"], atol=1e-4)
    np.testing.assert_allclose(targets.boxes, wanted["gt_bbox"], atol=1e-4)


def test_orders_of_a_ring_with_many_vertices_are_among_the_reference_s(golden_dir: Path):
    (ring,) = golden_instances(golden_dir, "bigring")
    orders = map_targets([ring], 20, **RANGES).pts_shifts[0].numpy()
    count = len(ring.points) - 1
    for order in orders:
        starts = np.abs(ring.points[:count] - order[0]).max(axis=1)
        assert starts.min() < 1e-4
    assert len(np.unique(orders[:, 0].round(4), axis=0)) == 19


def test_a_bev_mask_has_row_0_at_the_smallest_y():
    line = MapInstance(0, np.array([[-15.0, -30.0], [15.0, -30.0]]))
    mask = MakeBEVMask((200, 100), thickness_px=1).transform({"map_instances": [line], **RANGES})
    assert mask["gt_seg"].shape == (1, 200, 100)
    assert mask["gt_seg"][0, 0].sum() == 100
    assert mask["gt_seg"][0, 1:].sum() == 0


def test_a_camera_mask_draws_what_lies_in_front():
    """The camera looks along +y from 1.6 m above ground; the line crosses its axis 10 m ahead.

    At depth 10 the ground, 1.6 m below by default, lies 16 px below the centre (focal length 100):
    row 5 + 1.6 at stride 10.
    """
    lidar2img = np.array([[100, 50, 0, 0], [0, 50, -100, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])
    ahead = MapInstance(0, np.array([[-1.9, 10], [1.9, 10]]))
    behind = MapInstance(0, np.array([[-2.0, -10], [2, -10]]))
    results = {"map_instances": [ahead, behind], "lidar2img": [lidar2img], "img_shape": (100, 100)}
    transform = MakePVMask(stride=10, pad_size_divisor=20)
    mask = transform.transform(results)["gt_pv_seg"]
    assert mask.shape == (1, 1, 10, 10)
    assert mask[0, 0].nonzero().tolist() == [[6, col] for col in (3, 4, 5, 6)]


def test_a_camera_mask_lies_at_the_heights_of_the_file_if_that_is_asked_for(caplog):
    """The line of the test above, 1.4 m higher at its right end: row 5.2 in place of 6.6 there."""
    lidar2img = np.array([[100, 50, 0, 0], [0, 50, -100, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])
    ahead = MapInstance(0, np.array([[-1.9, 10], [1.9, 10]]))
    flat = {"map_instances": [ahead], "lidar2img": [lidar2img], "img_shape": (100, 100)}
    raised = {**flat, "map_heights": [np.array([-1.6, -0.2])]}

    def rows(results: dict, **options: bool) -> list[int]:
        step = MakePVMask(stride=10, pad_size_divisor=20, **options)
        mask = step.transform(dict(results))["gt_pv_seg"][0, 0]
        return sorted({row for row, _ in mask.nonzero().tolist()})

    assert rows(raised, heights=True) == [5, 6]
    assert rows(raised) == rows(flat) == [6]
    with caplog.at_level("INFO"):
        assert rows(flat, heights=True) == rows(flat, heights=True) == [6]
    said = [record for record in caplog.messages if "flat ground at z = -1.6 m" in record]
    assert len(said) <= 1  # once a process; another test may have been first


def test_each_class_can_have_a_channel(golden_dir: Path):
    """Together the channels are the one mask of all elements; a class has its own elements only."""
    instances = golden_instances(golden_dir, "many")
    lidar2img = np.array([[100, 50, 0, 0], [0, 50, -100, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])
    shared = {"lidar2img": [lidar2img], "img_shape": (96, 96), **RANGES}
    for kind, key in ((MakeBEVMask, "gt_seg"), (MakePVMask, "gt_pv_seg")):
        one = kind().transform({"map_instances": instances, **shared})[key]
        apart = kind(num_classes=3).transform({"map_instances": instances, **shared})[key]
        assert apart.shape[-3:] == (3, *one.shape[-2:])
        assert torch.equal(apart.amax(-3, keepdim=True), one)
        for label in range(3):
            own = [instance for instance in instances if instance.label == label]
            alone = kind().transform({"map_instances": own, **shared})[key]
            assert torch.equal(apart[..., label, :, :], alone[..., 0, :, :])


def test_a_label_beyond_the_channels_is_refused():
    line = MapInstance(3, np.array([[-15.0, -30.0], [15.0, -30.0]]))
    with pytest.raises(ValueError, match=r"label 3 of an element .* range for num_classes=3"):
        MakeBEVMask(num_classes=3).transform({"map_instances": [line], **RANGES})
