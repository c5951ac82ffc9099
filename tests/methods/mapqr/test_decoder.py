"""MapQR's decoder: the code of points, who sees whom, references of instances, Gaussians on it."""

import math

import pytest
import torch
from head_cases import (
    GSMAP,
    HEAD,
    LANES,
    N,
    P,
    assert_masks_hide_appended_queries,
    bev,
    build_head,
    train_a_step,
)
from mmengine.registry import init_default_scope

from gsmap.models.mapqr.decoder import sine_code
from gsmap.models.maptr.references import refine_reference

GROUPS = [{"num": N}, {"name": "one2many", "num": 2, "repeats": 2}]
DECODER = {**HEAD["decoder"], "type": "MapQRDecoder"}


@pytest.fixture(autouse=True)
def scope():
    init_default_scope("mmdet3d")


def mapqr(base=HEAD, mask_groups=False, **settings):
    decoder = {**DECODER, "layer": {**DECODER["layer"], "mask_groups": mask_groups}}
    return build_head(base, **{"decoder": decoder, "query_groups": GROUPS, **settings})


def test_the_code_of_a_point_by_hand():
    """Eight channels: of y, then of x, sine and cosine of 2 pi v, then of 2 pi v / 100."""
    x, y = 0.25, 0.5
    expected = [
        wave(2 * math.pi * value / divisor)
        for value in (y, x)
        for divisor in (1, 100)
        for wave in (math.sin, math.cos)
    ]
    assert sine_code(torch.tensor([x, y]), 8).tolist() == pytest.approx(expected, abs=1e-6)


def test_all_points_of_an_instance_start_and_move_by_its_one_state():
    head = mapqr().eval()
    start = head.reference.start(head.queries()[0][None])
    assert start.shape == (1, N * P, 2)
    assert len(start[0, :P].unique(dim=0)) == P  # each elsewhere
    outputs = head(bev())
    states = outputs[0].decoded.instance_states
    assert states.shape == (1, N, head.embed_dims)
    moved = head.reference.branches[0](states).unflatten(-1, (P, 2)).flatten(1, 2)
    expected = refine_reference(start, moved)
    torch.testing.assert_close(outputs[0].references.flatten(1, 2), expected)


def test_points_with_heights_have_three_entries():
    head = mapqr(reference={"coords": 3, "z_range": (-5.0, 3.0)}).eval()
    assert head(bev())[-1].pts.shape == (1, N, P, 3)


def test_groups_see_each_other_unless_they_are_masked():
    for masked in (False, True):
        head = mapqr(mask_groups=masked)
        alone = head.eval()(bev())[-1].scores
        together = head.train()(bev())[-1].scores[:, :N]
        assert torch.allclose(alone, together, atol=1e-6) == masked


@pytest.mark.parametrize("groups", [GROUPS[:1], GROUPS], ids=["one group", "two groups"])
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("base", [HEAD, GSMAP], ids=["points", "Gaussians"])
def test_masked_queries_of_a_hook_do_not_change_predictions(base, masked, groups):
    """Also where the groups see each other, queries that a hook has masked are not seen."""
    head = mapqr(base, mask_groups=masked, query_groups=groups)
    assert_masks_hide_appended_queries(head)


def test_the_learned_position_reaches_the_first_reference_alone():
    head = mapqr().eval()
    embedding = head.instance_embedding.weight.data
    state = head.decoder.layers[0](
        *(torch.randn(1, N, 16) for _ in range(2)), torch.rand(1, N * P, 2), bev()["bev_feats"]
    )
    assert state.shape == (1, N, 16)
    before = head(bev())[-1].pts
    embedding[:, :16] += 1.0
    start = head.reference.start
    assert not torch.allclose(head(bev())[-1].pts, before)
    kept = start(torch.zeros(1, N, 16))
    head.reference.start = lambda position: kept
    first = head(bev())[-1].pts
    embedding[:, :16] += 1.0
    torch.testing.assert_close(head(bev())[-1].pts, first)


@pytest.mark.parametrize("base", [HEAD, GSMAP], ids=["points", "Gaussians"])
def test_it_learns_with_both_query_groups(base):
    losses = train_a_step(mapqr(base), LANES)
    assert {"loss_cls", "loss_pts", "d0.loss_dir", "loss_pts_one2many"} <= set(losses)


def test_it_learns_with_gemaps_loss():
    losses = train_a_step(mapqr(losses=[*HEAD["losses"], {"type": "EuclideanLoss"}]), LANES)
    assert losses["loss_euclidean"] > 0
    assert "d0.loss_euclidean_one2many" in losses


def test_gaussians_start_neutral_on_it():
    """The points are those of the model without Gaussians; each has its own sigma and theta."""
    plain, gsmap = mapqr().eval(), mapqr(GSMAP).eval()
    gsmap.load_state_dict(plain.state_dict(), strict=False)
    torch.testing.assert_close(gsmap(bev())[-1].pts, plain(bev())[-1].pts)
    assert gsmap(bev())[-1].references.shape == (1, N, P, 5)


def test_channels_that_hold_no_code_are_refused():
    with pytest.raises(ValueError, match="embed_dims must be divisible by 4, got 18"):
        mapqr(embed_dims=18)


def test_embeddings_of_points_from_their_instance_are_refused():
    with pytest.raises(
        ValueError, match="MapQRDecoder has instance queries, which need no embeddings"
    ):
        mapqr({**HEAD, "points_from_instances": True})
    with pytest.raises(ValueError, match="leave out point_queries"):
        mapqr({**HEAD, "point_queries": {"type": "PointsOfInstances"}})
