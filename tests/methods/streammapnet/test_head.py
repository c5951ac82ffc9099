"""StreamMapNet's parts: shared branches, one label per query, orders of rings, bug switches."""

import pytest
import torch
from head_cases import (
    ALONG_X,
    ALONG_Y,
    HEAD,
    assert_neighbours_stay_apart_in_bfloat16,
    bev,
    build_head,
)

from gsmap.models.streammapnet.encoder import StreamMapNetEncoderLayer
from gsmap.models.streammapnet.losses import SmoothPointsCost
from gsmap.models.streammapnet.reference import LineReference

STREAM = {
    **HEAD,
    "type": "StreamMapNetHead",
    "losses": [{"type": "SmoothPointsLoss"}],
    "match_costs": [
        {"type": "mmdet.FocalLossCost", "weight": 5.0},
        {"type": "SmoothPointsCost"},
    ],
    "coder": None,
}


def test_all_layers_share_their_branches_and_lines_are_absolute():
    head = build_head(STREAM)
    assert head.embed_dims == 32  # twice the map's
    assert len({id(branch) for branch in head.cls_branches}) == 1
    assert len({id(branch) for branch in head.reference.branches}) == 1
    state = torch.randn(1, 4, 32)
    somewhere, elsewhere = torch.rand(2, 1, 20, 2)
    refined = [head.reference.refine(0, state, start) for start in (somewhere, elsewhere)]
    torch.testing.assert_close(*refined)


def test_every_query_has_one_label_the_best_first():
    head = build_head(STREAM).eval()
    (found,) = head.predict_by_feat(head(bev()), [{}])
    assert len(found.scores_3d) == 4
    assert (found.scores_3d.diff() <= 0).all()


def test_the_cost_chooses_the_order_by_its_own_distance():
    """Of (0.1, 0.1) and (0.2, 0): smooth L1 with beta 1 takes the first, L1 cannot choose."""
    cost = SmoothPointsCost(beta=1.0)
    pred = torch.zeros(1, 1, 2)
    orders = torch.tensor([[0.2, 0.0]]), torch.tensor([[0.1, 0.1]])
    distances = [float(cost.between_points(pred, order[None]).sum()) for order in orders]
    assert distances[1] < distances[0]


def test_the_mirrored_row_is_a_switch():
    cross = {"type": "SpatialCrossAttention", "num_levels": 1}
    grid = ALONG_X.with_size(4, 2)
    right, released = (
        StreamMapNetEncoderLayer(cross, mirrored=mirrored).centres(grid, torch.device("cpu"))
        for mirrored in (False, True)
    )
    assert right[0, 0].tolist() == pytest.approx([0.25, 0.125])
    assert released[0, 0].tolist() == pytest.approx([0.25, 0.875])


def test_neighbouring_points_stay_apart_in_bfloat16():
    assert_neighbours_stay_apart_in_bfloat16(LineReference(ALONG_Y, 8, 1))
