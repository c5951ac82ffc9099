"""GeMap: the geometry-decoupled attention and the Euclidean loss with its gradient."""

from collections.abc import Iterator

import torch

from gsmap.checkpoints.key_map import GEMAP
from gsmap.models.layers.geometry_attention import GeometryDecoupledAttention
from gsmap.models.losses.geometry import (
    EuclideanLoss,
    euclidean_relation_loss,
    euclidean_shape_loss,
)
from reference.golden import Golden
from reference.registry import check
from reference.report import Row, largest_difference, largest_relative, relative_norm

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
    loss = EuclideanLoss()(pred, target, counts)
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
