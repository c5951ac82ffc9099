"""HRMapNet's head: content queries, references from them, and the other methods with a prior."""

import pytest
import torch
from head_cases import HEAD, C, N, P, bev, build_head
from methods.hrmapnet.prior_cases import PRIOR
from model_cases import build_small, make_images, small_config
from prior_cases import frames

HRMAPNET = {**HEAD, "type": "HRMapNetHead"}


def test_queries_have_no_positional_half():
    head = build_head(HRMAPNET).eval()
    source, content = head.queries()
    assert source is content
    assert content.shape == (N * P, C)
    expected = head.instance_embedding.weight[1] + head.pts_embedding.weight[2]
    torch.testing.assert_close(content.unflatten(0, (N, P))[1, 2], expected)
    assert [part.out_features for part in head.reference.initial[::2]] == [C, C, 2]


def test_layers_get_no_position():
    head = build_head(HRMAPNET).eval()
    seen = []
    head.decoder.layers[0].register_forward_pre_hook(lambda _, args: seen.append(args[1]))
    with torch.no_grad():
        head(bev())
    assert seen[0].shape == (1, N * P, C)
    assert not seen[0].any()


OF_INSTANCES = {
    "type": "MGMapNetDecoder",
    "num_layers": 2,
    "num_levels": 1,
    "layer": {
        "num_heads": 4, "ffn_dims": 16, "dropout": 0.0, "cross_attn": {"ffn_dims": 16},
    },
}  # fmt: skip


@pytest.mark.parametrize(
    "head",
    [
        {"type": "MapHead"},
        {"type": "GSMapHead"},
        {"type": "HRMapNetHead"},
        {"type": "MapHead", "decoder": OF_INSTANCES},
    ],
    ids=["MapTR", "GSMap", "HRMapNet", "instance queries"],
)
def test_a_prior_is_a_switch_of_other_heads(head):
    """Each trains with it and predicts from a map."""
    head = {**small_config().map_head, **head}
    model = build_small(map_head=head, prior=PRIOR).train()
    for _ in range(2):
        samples = frames(("town", "a", 0.0), ("town", "b", 2.0))
        losses = model(make_images(2), samples, mode="loss")
        total, _ = model.parse_losses(losses)
        model.zero_grad()
        total.backward()
    assert model.prior.queries.label_encoder.weight.grad.abs().sum() > 0
    model.eval()
    for _ in range(2):
        with torch.no_grad():
            (sample,) = model(make_images(1), frames(("town", "a", 0.0)), mode="predict")
        assert sample.pred_instances_3d.pts.isfinite().all()


def test_a_model_without_a_prior_has_none():
    assert build_small().prior is None
