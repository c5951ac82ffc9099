"""One-to-one and one-to-many queries, on both heads."""

import pytest
import torch
from head_cases import GSMAP, HEAD, C, N, P, along_y, bev, build_head, elements, losses_of
from mmengine.structures import InstanceData
from predictions import predicted, stacked

FURTHER = {"name": "one2many", "num": 6, "repeats": 3}
GROUPS = [{"num": N}, FURTHER]
CONFIG = {**HEAD, "query_groups": GROUPS}
GAUSSIANS = {**GSMAP, "query_groups": GROUPS}


def build(config=CONFIG, **further):
    """Build a head in training; ``further`` replaces settings of the further queries."""
    return build_head(config, query_groups=[{"num": N}, {**FURTHER, **further}]).train()


def lines(num: int) -> InstanceData:
    """Straight lines along y, one metre apart, of all classes in turn."""
    return elements(*along_y(*range(num)), labels=[i % 3 for i in range(num)])


def test_further_queries_exist_in_training_only():
    head = build()
    assert stacked(head(bev(2))).pts.shape == (2, 2, 10, P, 2)
    assert stacked(head.eval()(bev(2))).pts.shape == (2, 2, N, P, 2)
    assert head.attention_mask() is None


@pytest.mark.parametrize("attention", ["PointSelfAttention", "DecoupledSelfAttention"])
@pytest.mark.parametrize("config", [CONFIG, GAUSSIANS], ids=["MapHead", "GSMapHead"])
def test_one_to_one_queries_predict_the_same_in_training_and_test(config, attention):
    layer = {**HEAD["decoder"]["layer"], "self_attn": {"type": attention}}
    head = build({**config, "decoder": {"num_layers": 2, "layer": layer}})
    (_, trained), _ = head.split_groups(head(bev()))
    tested = head.eval()(bev())
    for name in ("scores", "references"):
        values = [getattr(stacked(part), name) for part in (trained, tested)]
        torch.testing.assert_close(*values)


def test_mask_separates_the_groups():
    mask = build().attention_mask()
    assert mask.shape == (10, 10)
    assert mask[:N, N:].all()
    assert mask[N:, :N].all()
    assert not mask[:N, :N].any()
    assert not mask[N:, N:].any()


def test_the_further_queries_do_not_see_those_that_predict():
    head = build()
    before = stacked(head(bev())).scores
    with torch.no_grad():
        head.instance_embedding.weight[:N] += 3.0
    after = stacked(head(bev())).scores
    torch.testing.assert_close(before[:, :, N:], after[:, :, N:])
    assert not torch.allclose(before[:, :, :N], after[:, :, :N])


def test_every_ground_truth_is_matched_once_and_then_several_times():
    head = build()
    outputs = head(bev())
    gt, meta = lines(2), [{"token": "a"}]
    losses = head.loss_by_feat(outputs, [gt], meta)
    prepared = head.prepare_gts([gt])
    matched = {}
    for group, own in head.split_groups(outputs):
        pairs = head.match(own[1:], prepared, meta, group.repeats)
        matched[group.name] = torch.bincount(pairs.gt_inds).tolist()
        for name, value in head.group_losses(group, pairs).items():
            torch.testing.assert_close(losses[name], value)
    assert matched == {"": [1, 1], "one2many": [3, 3]}  # k = 3 queries for each element


def test_the_further_queries_do_not_change_the_losses_of_the_first():
    both = build()
    alone = build_head(HEAD).train()
    state = {key: value for key, value in both.state_dict().items() if "instance_emb" not in key}
    alone.load_state_dict(state, strict=False)
    alone.instance_embedding.weight.data = both.instance_embedding.weight[:N].detach()
    expected, losses = losses_of(alone, lines(2)), losses_of(both, lines(2))
    for name, value in expected.items():
        torch.testing.assert_close(losses[name], value)
    assert {name for name in losses if name.endswith("one2many")} == {
        f"{name}_one2many" for name in expected
    }


def test_flags_leave_a_loss_out_of_earlier_layers_and_of_further_queries():
    points, direction = HEAD["losses"]
    losses = [{**points, "last_layer_only": True}, {**direction, "first_group_only": True}]
    found = losses_of(build({**CONFIG, "losses": losses}), lines(2))
    names = {name for name in found if "pts" in name or "dir" in name}
    assert names == {"loss_pts", "loss_pts_one2many", "loss_dir", "d0.loss_dir"}


def test_more_repeats_than_queries_match_every_query():
    losses = losses_of(build(), lines(4))
    assert losses["loss_pts_one2many"].isfinite()  # 12 copies for 6 queries


def test_weight_of_the_further_queries():
    one, half = (losses_of(build(weight=weight), lines(2)) for weight in (1.0, 0.5))
    for name in ("loss_cls", "loss_pts", "d0.loss_dir"):
        torch.testing.assert_close(half[f"{name}_one2many"], one[f"{name}_one2many"] / 2)
        torch.testing.assert_close(half[name], one[name])


def test_no_further_queries_is_plain_maptr():
    head = build_head(HEAD).train()
    assert not [name for name in losses_of(head, lines(2)) if "one2many" in name]
    assert head.attention_mask() is None


def test_every_mask_is_drawn_once_for_both_groups(monkeypatch):
    head, drawn = build(GAUSSIANS), []
    draw = head.masks.draw
    monkeypatch.setattr(
        head.masks, "draw", lambda lines, *rest: drawn.append(len(lines)) or draw(lines, *rest)
    )
    losses_of(head, lines(2))
    assert drawn == [2, 2]  # for matching, and for the loss


def test_the_raster_loss_of_the_further_queries_compares_with_the_matched_masks():
    """The same Gaussians against the same elements cost the further queries what the first pay."""
    gt = lines(2)
    groups = [{"num": 2}, {"name": "one2many", "num": 4, "repeats": 2}]
    head = build_head(GSMAP, query_groups=groups).train()
    outputs = head(bev())
    references = torch.zeros_like(stacked(outputs).references)
    references[..., :2] = head.grid.norm_from_metres(gt.pts).repeat(3, 1, 1)  # three times both
    scores = torch.zeros_like(stacked(outputs).scores)
    outputs = predicted(head, scores, references)
    losses = head.loss_by_feat(outputs, [gt], [{}])
    assert losses["loss_pts"] < 1e-5
    torch.testing.assert_close(losses["loss_raster_one2many"], losses["loss_raster"])
    crossed = head.prepare_gts([gt])
    crossed.masks = crossed.masks.flip(0)
    _, (group, further) = head.split_groups(outputs)
    pairs = head.match(further[-1:], crossed, [{}], group.repeats)
    others = head.group_losses(group, pairs)
    assert others["loss_raster_one2many"] > 1.1 * losses["loss_raster_one2many"]


def test_the_further_queries_can_do_without_the_raster_loss():
    every = build(GAUSSIANS)
    first = build(GAUSSIANS, losses=("cls", "pts", "dir"))
    expected, losses = (losses_of(head, lines(2)) for head in (every, first))
    assert set(expected) - set(losses) == {"loss_raster_one2many", "d0.loss_raster_one2many"}
    for name, loss in losses.items():  # what is matched with what does not change
        torch.testing.assert_close(loss, expected[name])


def instance_queries(head):
    return head.state_dict()["instance_embedding.weight"]


@pytest.mark.parametrize("num", [2, 6, 9])
def test_checkpoint_with_another_number_of_further_queries(num, monkeypatch):
    lines = []
    monkeypatch.setattr("gsmap.models.base.head.print_log", lambda line, **_: lines.append(line))
    loaded = instance_queries(build(num=num)).clone()
    head = build()
    own = instance_queries(head).clone()
    state = {"map_head.instance_embedding.weight": loaded}
    head.fit_state(state, "map_head.")
    fitted = state["map_head.instance_embedding.weight"]
    both = min(len(loaded), len(own))
    assert fitted.shape == own.shape
    assert torch.equal(fitted[:both], loaded[:both])
    assert torch.equal(fitted[both:], own[both:])
    assert len(lines) == (len(loaded) != len(own))
    assert all("set model.map_head.query_groups.0.num" in line for line in lines)


def test_a_checkpoint_without_further_queries_starts_training_with_them():
    loaded = instance_queries(build_head(HEAD)).clone()
    state = {"instance_embedding.weight": loaded}
    head = build()
    head.fit_state(state, "")
    assert torch.equal(state["instance_embedding.weight"][:N], loaded)
    assert len(state["instance_embedding.weight"]) == N + 6


def test_checkpoint_with_fewer_predicting_queries_is_left_for_the_strict_check():
    state = {"map_head.instance_embedding.weight": torch.zeros(N - 1, 2 * C)}
    build().fit_state(state, "map_head.")
    assert state["map_head.instance_embedding.weight"].shape == (N - 1, 2 * C)
