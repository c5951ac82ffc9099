import pytest
import torch
from head_cases import HEAD, LANES, along_y, bev, build_head, elements, with_layer
from predictions import triples

from gsmap.models.gemap.attention import GeometryDecoupledAttention
from gsmap.models.gemap.losses import euclidean_relation_loss, euclidean_shape_loss
from gsmap.models.maptrv2.attention import DecoupledSelfAttention

GEMAP = {**HEAD, "type": "GeMapHead"}
MAPTRV2 = {
    **HEAD,
    "decoder": with_layer(HEAD, self_attn={"type": "DecoupledSelfAttention"}),
    "query_groups": [{"num": 4}, {"name": "one2many", "num": 6, "repeats": 2}],
}


@pytest.mark.parametrize("base", [HEAD, MAPTRV2], ids=["maptr", "maptrv2"])
def test_gemap_is_its_attention_and_its_loss_on_either_base(base):
    head = build_head(base, type="GeMapHead")
    assert isinstance(head.decoder.layers[1].self_attn, GeometryDecoupledAttention)
    assert list(head.losses) == ["pts", "dir", "euclidean"]
    assert [group.num for group in head.query_groups] == [4]
    outputs = head(bev(2))
    losses = head.loss_by_feat(outputs, [LANES, elements(*along_y(-5, 0, 5))], [{}, {}])
    assert {f"{layer}loss_euclidean" for layer in ("", "d0.")} <= set(losses)


def test_the_loss_compares_relations_within_each_sample_only():
    """The whole batch's loss is its shapes' mean and the samples' relations, added up."""
    head = build_head(GEMAP)
    outputs, truths = head(bev(2)), [LANES, elements(*along_y(-5, 0, 5))]
    actual = head.loss_by_feat(outputs, truths, [{}, {}])["loss_euclidean"]
    gts = head.prepare_gts(truths)
    ((_, own),) = head.split_groups(outputs)
    pairs = head.match(own[1:], gts, [{}, {}])
    samples = zip(own[1].pts, *triples(pairs), strict=True)
    points = torch.cat([pts[match[:, 0]] for pts, match in samples]), pairs.gt_pts
    shape = euclidean_shape_loss(*points)
    expected = 0.005 * (shape + euclidean_relation_loss(*points, [2, 3]))
    torch.testing.assert_close(actual, expected)
    whole = 0.005 * (shape + euclidean_relation_loss(*points, [5]))
    assert not torch.isclose(expected, whole)


def test_parts_of_gemap_can_be_left_out():
    head = build_head(MAPTRV2, type="GeMapHead", decoupled=False, loss_euclidean=None)
    assert isinstance(head.decoder.layers[0].self_attn, DecoupledSelfAttention)
    assert list(head.losses) == ["pts", "dir"]
    groups = [{"num": 4}, {"name": "more", "num": 6, "losses": ("cls", "pts")}]
    both = build_head(GEMAP, query_groups=groups, one_to_many=True)
    losses = both.loss_by_feat(both(bev()), [LANES], [{}])
    assert "loss_euclidean" in losses
    assert "loss_pts_more" in losses
    assert "loss_euclidean_more" not in losses


def test_settings_of_gemaps_attention_are_kept():
    attention = {"type": "GeometryDecoupledAttention", "ffn_dims": 24}
    head = build_head(GEMAP, decoder=with_layer(HEAD, self_attn=attention))
    assert head.decoder.layers[0].self_attn.intra.ffn[0].out_features == 24
