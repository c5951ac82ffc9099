"""GeMap: its attention, its loss with the gradient, state, forward pass and head."""

from collections.abc import Iterator

import torch
from predictions import pairs_of, stacked
from reference.golden import Golden
from reference.maptr import decoded_rows, head_loss_rows, state_rows
from reference.registry import check
from reference.report import Row, largest_difference, largest_relative, relative_norm

from gsmap.models.gemap.attention import GeometryDecoupledAttention
from gsmap.models.gemap.keys import GEMAP
from gsmap.models.gemap.losses import EuclideanLoss, euclidean_relation_loss, euclidean_shape_loss

CONFIG = "gemap/gemap_simple_r50_24e.py"
MODEL_STATE = "gemap_simple_r50_state.json"
LOSSES = {
    "loss_cls": "loss_cls",
    "loss_pts": "loss_pts",
    "loss_dir": "loss_dir",
    "loss_geo_2": "loss_euclidean",
}

UPSTREAM = "pts_bbox_head.transformer.decoder.layers.0.attentions.0."
OURS = "map_head.decoder.layers.0.self_attn."
STATE = "gemap_gda_state.json"
SIZES = {"small": (6, 5, 1), "full": (50, 20, 20)}  # instances, points, every how many-th query
NUM_CLASSES, NUM_INSTANCES = 3, 50
LOW_M, SIZE_M = torch.tensor([-15.0, -30.0]), torch.tensor([30.0, 60.0])


@check("gemap_gda_{variant}.npz")
def check_attention(golden: Golden, name: str) -> Iterator[Row]:
    """Compare the attention's output."""
    data, shapes = golden.read_arrays(name), golden.read_json(STATE)
    state = {}
    for key, shape in shapes.items():
        ours = GEMAP.to_ours(UPSTREAM + key)
        assert ours is not None
        weight = golden.weights.tensor("gda." + key, shape, golden.seed)
        state[ours.removeprefix(OURS)] = torch.from_numpy(weight)
    for size, (instances, points, step) in SIZES.items():
        wanted = data[f"{size}_out"]
        attention = GeometryDecoupledAttention(num_points=points).eval()
        attention.load_state_dict(state)
        shape = (instances * points, wanted.shape[1], wanted.shape[2])
        query = torch.from_numpy(golden.inputs.normal(f"gda_query_{size}", shape, golden.seed))
        with torch.no_grad():
            out = attention(query.transpose(0, 1)).transpose(0, 1)[::step]
        yield Row(name, f"{size}_out", largest_difference(out, wanted), 1e-5)


@check("gemap_geoloss_{variant}.npz")
def check_loss(golden: Golden, name: str) -> Iterator[Row]:
    """Compare the loss, its parts and its gradient."""
    data = {key: torch.from_numpy(value) for key, value in golden.read_arrays(name).items()}
    matched = data["labels"] < NUM_CLASSES
    counts = matched.unflatten(0, (-1, NUM_INSTANCES)).sum(1).tolist()
    leaf = data["pred"].requires_grad_()
    pred, target = leaf[matched], ((data["target_m"] - LOW_M) / SIZE_M)[matched]
    loss = EuclideanLoss()(pairs_of(pred_pts=pred, gt_pts=target, counts=counts))
    loss.backward()
    assert leaf.grad is not None
    shape = euclidean_shape_loss(pred, target)
    relation = euclidean_relation_loss(pred, target, counts)
    for quantity, value in (
        ("loss", loss),
        ("intra_unweighted", shape),
        ("inter_unweighted", relation),
    ):
        off = largest_relative(value.detach(), data[quantity])
        yield Row(name, f"{quantity} (relative)", off, 1e-4)
    yield Row(name, "gradient (relative)", relative_norm(leaf.grad, data["grad"]), 1e-3)


@check(MODEL_STATE)
def check_state(golden: Golden, name: str) -> Iterator[Row]:
    """Compare the state of GeMap with its simple objective with ours."""
    yield from state_rows(golden, name, CONFIG)


@check("gemap_simple_r50_forward_reduced_{variant}.npz")
@torch.no_grad()
def check_forward(golden: Golden, name: str) -> Iterator[Row]:
    """Compare the way from the images to the detections."""
    data = golden.read_arrays(name)
    model, meta = golden.model(CONFIG, MODEL_STATE), golden.meta("reduced")
    bev_outputs = model.bev_encoder(model.extract_img_feats(golden.images("reduced")), [meta])
    bev = bev_outputs["bev_feats"][0][:, data["bev_rows"]][:, :, data["bev_cols"]]  # (C, h, w)
    off = largest_difference(bev.flatten(1).T, data["bev_embed_sub"])
    yield Row(name, "BEV features", off, 1e-4)
    outputs = model.map_head(bev_outputs)
    scores, pts = stacked(outputs).scores, stacked(outputs).pts
    for key, value, atol in (("all_cls_scores", scores, 5e-4), ("all_pts_preds", pts, 1e-4)):
        yield Row(name, key, largest_difference(value, data[key]), atol)
    yield from decoded_rows(name, data, model.map_head.predict_by_feat(outputs, [meta])[0])


@check("gemap_headloss_*_{variant}.npz")
def check_head(golden: Golden, name: str) -> Iterator[Row]:
    """Compare matches and losses of the head on its own predictions."""
    head = golden.model(CONFIG, MODEL_STATE).map_head
    predictions = f"gemap_simple_r50_forward_reduced_{golden.variant}.npz"
    yield from head_loss_rows(golden, name, head, predictions, LOSSES)
