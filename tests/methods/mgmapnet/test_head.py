"""MGMapNet's head: what it adds to a config, what its losses read, and Gaussians on its decoder."""

import pytest
import torch
from head_cases import (
    GSMAP,
    HEAD,
    MASKS,
    C,
    N,
    P,
    along_y,
    assert_masks_hide_appended_queries,
    bev,
    build_head,
    elements,
    losses_of,
    with_layer,
)
from mmdet3d.registry import MODELS
from mmdet3d.structures import Det3DDataSample
from predictions import stacked

from gsmap.models.gsmap.guidance import GaussianGuidance
from gsmap.models.gsmap.layer import add_guidance
from gsmap.models.maptr.self_attention import PointSelfAttention
from gsmap.models.mgmapnet.decoder import MGMapNetDecoder
from gsmap.models.mgmapnet.head import convert_decoder

FURTHER = {"name": "one2many", "num": 6, "repeats": 3}
BEV = {"bev_feats": torch.randn(1, C, 8, 4, generator=torch.Generator().manual_seed(2))}
MGMAP = {
    **HEAD,
    "type": "MGMapHead",
    "query_groups": [{"num": N}, FURTHER],
    "masks": {"pixel_m": 3.75},  # 16 x 8, twice as fine as the features
}
LANES = elements(*along_y(-3, 4), labels=[0, 2])
NAMES = ["pts", "dir", "mean_loc", "ins_seg"]


def losses(head, gt=LANES, batch=1):
    feats = {"bev_feats": BEV["bev_feats"].expand(batch, -1, -1, -1)}
    return head.loss_by_feat(head.train()(feats), [gt] * batch, [{"token": "a"}] * batch)


def test_one_word_makes_mgmapnet_of_any_head():
    decoupled = {"self_attn": {"type": "DecoupledSelfAttention"}, "cross_attn": {"num_points": 3}}
    layer = {**HEAD["decoder"]["layer"], **decoupled}
    head = build_head(MGMAP, decoder={"num_layers": 2, "layer": layer})
    assert isinstance(head.decoder, MGMapNetDecoder)
    assert list(head.losses) == NAMES
    assert head.pts_embedding is None
    assert head.masks.line_width_m == 3 * 3.75
    attention = {"p2i": False, "num_samples": 3}
    own = {"type": "MGMapNetDecoder", "num_layers": 1, "layer": {"cross_attn": attention}}
    own["layer"]["num_heads"] = 4
    assert build_head(MGMAP, decoder=own).decoder.layers[0].cross_attn.p2i is None


@pytest.mark.parametrize("further", [[], [FURTHER]], ids=["one group", "two groups"])
@pytest.mark.parametrize("base", [MGMAP, GSMAP], ids=["points", "Gaussians"])
def test_masked_queries_of_a_hook_do_not_change_predictions(base, further):
    """Points attend to the instances of all groups, but not to those that a hook has masked."""
    decoder = convert_decoder(HEAD["decoder"])
    head = build_head(base, decoder=decoder, query_groups=[{"num": N}, *further])
    assert_masks_hide_appended_queries(head, BEV)


@MODELS.register_module()
class LouderSelfAttention(PointSelfAttention):
    """A self-attention of somebody else."""


@pytest.mark.parametrize(
    ("attention", "kind"),
    [
        ({"type": "LouderSelfAttention"}, LouderSelfAttention),
        ({"type": LouderSelfAttention}, LouderSelfAttention),
        ({"dropout": 0.25}, PointSelfAttention),
        ({"type": "DecoupledSelfAttention"}, PointSelfAttention),  # MapTRv2's, for points
    ],
)
def test_a_self_attention_reaches_the_layers_unless_it_is_the_base_methods(attention, kind):
    head = build_head(MGMAP, decoder=with_layer(HEAD, self_attn=attention))
    for layer in head.decoder.layers:
        assert type(layer.self_attn) is kind
        assert layer.self_attn.num_points == 1
        assert layer.self_attn.dropout == attention.get("dropout", 0.0)


def test_the_log_says_what_of_the_decoder_is_replaced(monkeypatch):
    lines = []
    monkeypatch.setattr("gsmap.models.mgmapnet.head.print_log", lambda text, *_: lines.append(text))
    layer = {"self_attn": {"type": "DecoupledSelfAttention"}, "cross_attn": {"num_points": 3}}
    convert_decoder({"layer": {**layer, "ffn_dims": 32}})
    assert lines == [f"MGMapHead replaces {layer} of its decoder's layers."]
    convert_decoder({"layer": {"ffn_dims": 32}})
    assert len(lines) == 1


def test_outputs_by_instance_and_by_point():
    head = build_head(MGMAP)
    outputs = head.train()(BEV)
    num = N + FURTHER["num"]
    assert stacked(outputs).scores.shape == (2, 1, num, 3)
    assert stacked(outputs).pts.shape == (2, 1, num, P, 2)
    assert stacked(outputs).mean_locations.shape == (2, 1, num, P, 2)
    assert stacked(outputs).instance_states.shape == (2, 1, num, C)
    assert stacked(head.eval()(BEV)).mean_locations.shape == (2, 1, N, P, 2)


def test_the_classes_come_from_the_instance_states():
    head = build_head(MGMAP).eval()
    outputs = head(BEV)
    expected = head.cls_branches[1](stacked(outputs).instance_states[1])
    torch.testing.assert_close(stacked(outputs).scores[1], expected)


def test_other_decoders_offer_the_mean_of_their_points_as_instance_states():
    head = build_head(HEAD).eval()
    outputs = head(bev())
    means = stacked(outputs).point_states.mean(3)
    assert torch.equal(stacked(outputs).instance_states, means)
    part = {"type": "InstanceMaskLoss", "embed_dims": C}
    head = build_head(HEAD, losses=[*HEAD["losses"], part], masks={"pixel_m": 3.0})
    assert losses_of(head.train(), LANES)["loss_ins_seg"] > 0


def test_masks_of_instances_belong_to_the_last_layer_of_the_queries_that_predict():
    found = losses(build_head(MGMAP))
    layers = {name for name in found if "ins_seg" in name}
    assert layers == {"loss_ins_seg"}
    for prefix in ("", "d0."):
        assert {f"{prefix}loss_mean_loc", f"{prefix}loss_mean_loc_one2many"} <= set(found)


@pytest.mark.parametrize("gt", [elements(), LANES], ids=["none", "two"])
def test_every_parameter_is_trained(gt):
    seg = [{"type": "BEVMaskHead", "num_masks": 3}, {"type": "NormedPVMaskHead", "num_masks": 3}]
    head = build_head(MGMAP, aux_heads=seg).train()
    sample = Det3DDataSample(metainfo={"token": "a"})
    sample.gt_instances_3d = gt
    sample.gt_seg, sample.gt_pv_seg = torch.zeros(3, 8, 4), torch.zeros(2, 3, 3, 4)
    found = head.loss({**BEV, "img_feats": bev()["img_feats"]}, [sample])
    sum(value for name, value in found.items() if "loss" in name).backward()
    assert [name for name, p in head.named_parameters() if p.grad is None] == []
    assert all(p.grad.isfinite().all() for p in head.parameters())


def test_instance_masks_learn_the_lane_of_their_own_sample():
    head = build_head(MGMAP, loss_ins_seg={"loss_weight": 1.0, "dice_weight": 0.0})
    optimizer = torch.optim.Adam(head.losses["ins_seg"].parameters(), 0.1)
    first = losses(head)["loss_ins_seg"]
    for _ in range(20):
        loss = losses(head)["loss_ins_seg"]
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert loss < 0.7 * first


def test_parts_of_mgmapnet_can_be_left_out():
    head = build_head(MGMAP, loss_mean_loc=None, loss_ins_seg=None)
    assert list(head.losses) == ["pts", "dir"]
    released = build_head(MGMAP, loss_ins_seg={"pairing": "released"})
    assert released.losses["ins_seg"].pairing == "released"
    assert released.losses["ins_seg"].loss_weight == 3.0


def test_prediction_has_the_fields_of_any_head():
    sample = Det3DDataSample(metainfo={"token": "a"})
    (result,) = build_head(MGMAP).eval().predict(BEV, [sample])
    assert result.pts.shape[1:] == (P, 2)
    assert set(result.keys()) == {"pts", "scores_3d", "labels_3d"}


def test_gaussians_on_mgmapnets_decoder():
    layer = HEAD["decoder"]["layer"]
    decoder = {"type": "MGMapNetDecoder", "num_layers": 2, "layer": layer}
    parts = [*HEAD["losses"], {"type": "SamplingLocationLoss"}]
    shared = {"decoder": decoder, "losses": parts, "query_groups": [{"num": N}, FURTHER]}
    head = build_head(GSMAP, masks=MASKS, **shared)
    assert all(part.guidance is not None for part in head.decoder.layers)
    assert stacked(head(BEV)).references.shape == (2, 1, N + FURTHER["num"], P, 5)
    found = losses(head)
    assert found["loss_raster"] > 0
    assert found["loss_mean_loc"] > 0
    sum(value for name, value in found.items() if "loss" in name).backward()
    plain = {**decoder, "layer": {**layer, "guidance": None}}
    head = build_head(GSMAP, masks=MASKS, **{**shared, "decoder": plain})
    assert all(part.guidance is None for part in head.decoder.layers)


def test_points_with_height_are_codes_and_predictions_of_three_numbers():
    layer = {**HEAD["decoder"]["layer"], "reference_dims": 3}
    decoder = {"type": "MGMapNetDecoder", "num_layers": 2, "layer": layer}
    head = build_head(MGMAP, decoder=decoder, reference={"coords": 3, "z_range": (-5, 3)})
    assert head.decoder.layers[1].reference_code[0].in_features == 3 * P
    outputs = head(BEV)
    assert stacked(outputs).pts.shape[-1] == 3
    assert stacked(outputs).mean_locations.shape[-1] == 2


def test_a_loss_of_samples_needs_a_decoder_that_tells_them():
    with pytest.raises(ValueError, match=r"SamplingLocationLoss needs .* got MapDecoder"):
        build_head(HEAD, losses=[{"type": "SamplingLocationLoss"}])


def test_layers_of_the_decoder_are_guided_by_a_part_and_stay():
    layer = {"ffn_dims": 4, "guidance": {"type": GaussianGuidance, "embed_hidden_dims": 2}}
    own = {"ffn_dims": 4, "guidance": {"embed_hidden_dims": 2}}
    found = add_guidance({"type": MGMapNetDecoder, "layer": own})
    assert found == {"type": MGMapNetDecoder, "layer": layer}
    assert add_guidance({"type": MGMapNetDecoder, "layer": {"guidance": None}})["layer"] == {
        "guidance": None
    }


def test_a_layer_class_of_another_decoder_is_refused():
    decoder = {"type": MGMapNetDecoder, "layer": {"type": "GaussianDecoderLayer"}}
    with pytest.raises(ValueError, match=r"MGMapNetDecoder.* are of a class of its own.*type out"):
        add_guidance(decoder)
