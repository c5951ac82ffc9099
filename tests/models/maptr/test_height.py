"""Points with height through the whole head: targets, matching, losses, detections."""

import pytest
import torch
from head_cases import GSMAP, HEAD, N, P, bev, build_head, elements, losses_of, train_a_step
from mmengine.structures import InstanceData
from predictions import predicted

Z_RANGE = (-5.0, 3.0)
GAUSSIANS = {**GSMAP, "masks": {"pixel_m": 0.75, "cost_pixel_m": 0.75}}
HEIGHT = {"reference": {"coords": 3, "z_range": Z_RANGE}}


def raised(gt: InstanceData, *heights: float) -> InstanceData:
    """Return targets with a height that runs evenly from each element's first point to its last."""
    ends = torch.tensor(heights).view(len(gt), 2)
    steps = torch.linspace(0, 1, P)
    z = ends[:, :1] * (1 - steps) + ends[:, 1:] * steps  # (K, P)
    gt.pts = torch.cat([gt.pts, z[..., None]], -1)
    gt.pts_shifts = torch.stack([gt.pts, gt.pts.flip(1)], 1)
    return gt


def predicting(head: torch.nn.Module, points_m: torch.Tensor) -> list:
    """Return outputs of one layer that say these points (N, P, 3), each a sure divider."""
    norm = head.reference.norm(points_m)[None, None]
    scores = torch.tensor([5.0, -5.0, -5.0]).expand(1, 1, len(points_m), 3)
    return predicted(head, scores, norm)


def losses_against(head: torch.nn.Module, points_m: torch.Tensor, gt: InstanceData) -> dict:
    """Return the losses of predicted points (N, P, 3) in metres."""
    return head.loss_by_feat(predicting(head, points_m), [gt], [{"token": "a"}])


def test_losses_of_height_by_hand():
    """A line at z = -1 where the road climbs from -1 to 3 m over its 4 m: a slope of 45 degrees.

    Heights are off by 0, 1, 2, 3, 4 m of a range of 8 m; every edge turns by 45 degrees.
    """
    head = build_head(HEAD, **HEIGHT)
    gt = raised(elements(((0, 0), (0, 4))), -1.0, 3.0)
    flat = gt.pts.clone()
    flat[..., 2] = -1.0
    losses = losses_against(head, flat, gt)
    assert losses["loss_pts"].item() == pytest.approx(5.0 * 10 / 8, rel=1e-5)
    turn = 1 - 0.5**0.5
    assert losses["loss_dir"].item() == pytest.approx(0.005 * (P - 1) * turn, rel=1e-4)


def test_of_two_lines_above_each_other_each_is_matched_at_its_own_height():
    head = build_head(HEAD, **HEIGHT)
    road, bridge = ((0, 0), (0, 4)), ((0, 0), (0, 4))
    gt = raised(elements(road, bridge), -1.0, -1.0, 2.0, 2.0)
    losses = losses_against(head, gt.pts.flip(0), gt)
    assert losses["loss_pts"].item() == pytest.approx(0, abs=1e-4)


def test_a_height_beyond_the_range_counts_as_its_end():
    head = build_head(HEAD, **HEIGHT)
    gt = raised(elements(((0, 0), (0, 4))), 5.0, 5.0)
    at_the_end = gt.pts.clone()
    at_the_end[..., 2] = 3.0
    assert losses_against(head, at_the_end, gt)["loss_pts"].item() == pytest.approx(0, abs=1e-4)


def test_targets_without_height_are_refused():
    head = build_head(HEAD, **HEIGHT)
    with pytest.raises(ValueError, match="3 coordinates, the targets' 2: set dim=3 in the data"):
        losses_of(head, elements(((0, 0), (0, 4))))


def test_a_model_of_two_coordinates_ignores_the_height_of_targets():
    head = build_head(HEAD).eval()
    flat = elements(((0, -9), (0, 9)), ((3, 0), (3, 9)))
    wanted = losses_of(head, flat)
    found = losses_of(head, raised(flat, 0.0, 1.0, -2.0, 2.0))
    assert {k: v.item() for k, v in found.items()} == {k: v.item() for k, v in wanted.items()}


@pytest.mark.parametrize("config", [HEAD, GAUSSIANS], ids=["points", "gaussians"])
@pytest.mark.parametrize("count", [0, 1, 3])
def test_a_step_and_detections_of_three_coordinates(config, count):
    head = build_head(config, **HEIGHT)
    lines = [((x, -20), (x, 20)) for x in range(count)]
    gt = raised(elements(*lines), *[-1.0, 1.0] * count)
    train_a_step(head, gt)
    head.eval()
    (found,) = head.predict_by_feat(head(bev()), [{}])
    assert found.pts.shape[1:] == (P, 3)
    assert 0 < len(found) <= 2 * N
    assert ((found.pts[..., 2] > Z_RANGE[0]) & (found.pts[..., 2] < Z_RANGE[1])).all()
    if config is GAUSSIANS:
        assert found.scales.shape == (*found.pts.shape[:2], 2)
        assert found.rotations.shape == found.pts.shape[:2]


def test_masks_of_gaussians_do_not_see_the_height():
    head = build_head(GAUSSIANS, **HEIGHT, match_costs=HEAD["match_costs"][:1]).eval()
    line = ((0, -20), (0, 20))
    low, high = (losses_of(head, raised(elements(line), z, z)) for z in (-1.0, 1.0))
    assert low["loss_pts"] != high["loss_pts"]
    torch.testing.assert_close(low["loss_raster"], high["loss_raster"])


def test_the_margin_of_detections_lies_in_the_plane():
    head = build_head(HEAD, **HEIGHT)
    scores = torch.zeros(2, 3)
    points = torch.zeros(2, P, 3)
    points[0, :, 2], points[1, :, 0] = 99.0, 99.0
    assert set(head.coder.decode(scores, points).query_inds.tolist()) == {0}
