"""Heads of few queries and channels, and the BEV features that they read."""

import copy

import torch
from mmdet3d.registry import MODELS
from mmengine.structures import InstanceData
from model_cases import disable_dropout, straight_elements

import gsmap.registered  # noqa: F401
from gsmap.models.base.decoder import Queries
from gsmap.models.base.hooks import FlowHook, FlowStart
from gsmap.models.base.pairs import Predictions
from gsmap.structures.grid import BEVGrid

N, P, C = 4, 5, 16
CLASSES = ("divider", "ped_crossing", "boundary")
ALONG_Y = BEVGrid((-15, 15), (-30, 30))  # nuScenes: y points forward
ALONG_X = BEVGrid((-30, 30), (-15, 15))  # Argoverse 2: x points forward
HEAD = {
    "type": "MapHead",
    "grid": ALONG_Y,
    "classes": CLASSES,
    "query_groups": [{"num": N}],
    "num_points": P,
    "embed_dims": C,
    "decoder": {"num_layers": 2, "layer": {"num_heads": 4, "ffn_dims": 32, "dropout": 0.0}},
    "match_costs": [
        {"type": "mmdet.FocalLossCost", "weight": 2.0},
        {"type": "OrderedPointsCost", "weight": 5.0},
    ],
    "loss_cls": {"type": "mmdet.FocalLoss", "use_sigmoid": True, "loss_weight": 2.0},
    "losses": [
        {"type": "PointsLoss", "loss_weight": 5.0},
        {"type": "DirectionLoss", "loss_weight": 0.005},
    ],
    "coder": {"max_num": 8},
}
MASKS = {"pixel_m": 1.5, "cost_pixel_m": 0.75}  # 40 x 20 and 80 x 40
GSMAP = {
    **HEAD,
    "type": "GSMapHead",
    "masks": MASKS,
    "reference": {"min_scale_m": 0.15},  # finer than half of these coarse pixels
}


def with_layer(config: dict, **settings) -> dict:
    """Return a head's decoder config with other settings of its layer."""
    return {**config["decoder"], "layer": {**config["decoder"]["layer"], **settings}}


def build_head(config: dict, **settings) -> torch.nn.Module:
    """Build a head with reproducible weights; ``settings`` replace parts of its config."""
    torch.manual_seed(0)
    head = MODELS.build(copy.deepcopy({**config, **settings}))
    head.init_weights()
    return head


def bev(batch: int = 1) -> dict[str, torch.Tensor]:
    """Return what a BEV encoder gives a head; the same at every call."""
    generator = torch.Generator().manual_seed(1)
    return {
        "bev_feats": torch.randn(batch, C, 10, 5, generator=generator),
        "img_feats": torch.randn(batch, 2, C, 3, 4, generator=generator),
    }


def elements(*lines, labels=None) -> InstanceData:
    """Return the ground truth of one sample from straight lines ((x0, y0), (x1, y1)) in metres."""
    return straight_elements(*lines, labels=labels, num_points=P)


LANES = elements(((-3, -20), (-3, 20)), ((3, -20), (4, 20)), labels=[0, 2])


def along_y(*xs: float) -> list:
    """Return lines of 40 m along y, at these x."""
    return [((x, -20), (x, 20)) for x in xs]


def predictions_of(head: torch.nn.Module, outputs: list, layer: int = 1) -> Predictions:
    """Return what costs and losses read of the first query group's predictions."""
    _, own = next(head.split_groups(outputs))
    return own[layer]


def losses_of(head: torch.nn.Module, *gts: InstanceData) -> dict[str, torch.Tensor]:
    """Return a head's losses of one batch."""
    return head.loss_by_feat(head(bev(len(gts))), gts, [{"token": "a"}] * len(gts))


def train_a_step(head: torch.nn.Module, gt: InstanceData) -> dict[str, torch.Tensor]:
    """Train one step, check that every gradient is finite, and return the losses before it."""
    losses = losses_of(head.train(), gt)
    head.zero_grad()
    sum(value for name, value in losses.items() if "loss" in name).backward()
    gradients = [p.grad for p in head.parameters() if p.grad is not None]
    assert gradients
    assert all(gradient.isfinite().all() for gradient in gradients)
    torch.optim.SGD(head.parameters(), 1e-3).step()
    return losses


class AppendedQueries(FlowHook):
    """Random queries that are appended to those of a head, as noised queries are in training.

    Args:
        num: Number of instances.
        leaks: Let the queries of the head attend to them.
    """

    def __init__(self, num: int = 3, leaks: bool = False) -> None:
        self.num, self.leaks, self.total = num, leaks, 0

    def start(self, head: torch.nn.Module, start: FlowStart) -> FlowStart:
        self.total = sum(group.num for group in head.query_groups)
        further = []
        for values in start.queries:
            rows = values.shape[1] // self.total * self.num
            further.append(torch.rand(len(values), rows, values.shape[2]))
        joined = [torch.cat(both, 1) for both in zip(start.queries, further, strict=True)]
        mask = torch.zeros(2 * [self.total + self.num], dtype=torch.bool)
        if start.mask is not None:
            mask[: self.total, : self.total] = start.mask
        mask[: self.total, self.total :] = not self.leaks
        return FlowStart(Queries(*joined), mask)

    def outputs(self, head: torch.nn.Module, layers: list[Predictions]) -> list[Predictions]:
        return [layer.of_queries(slice(self.total)) for layer in layers]


def assert_masks_hide_appended_queries(head: torch.nn.Module, feats: dict | None = None) -> None:
    """Check that queries which a hook appends and masks do not change a head's predictions."""
    feats = feats or bev()
    for parameter in head.parameters():
        parameter.data += 0.1 * torch.randn_like(parameter)  # so that nothing starts neutral
    disable_dropout(head).train()
    with torch.no_grad():
        plain, hidden, leaked = (
            head(feats, hooks) for hooks in ((), [AppendedQueries()], [AppendedQueries(leaks=True)])
        )
    for layers in zip(plain, hidden, leaked, strict=True):
        expected, found, other = (layer.scores for layer in layers)
        torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)
        assert not torch.allclose(other, expected, atol=1e-4)
        expected, found, _ = (layer.pts for layer in layers)
        torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)


def assert_neighbours_stay_apart_in_bfloat16(reference: torch.nn.Module) -> None:
    """Check a reference of 8 channels and one layer on neighbouring points."""
    torch.manual_seed(0)
    reference.eval()
    states = (5 * torch.randn(1, 8) + torch.linspace(0, 1e-3, 20)[:, None])[None]
    start = reference.start(states)
    expected = reference.refine(0, states, start)[..., :2]
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(reference.start(states)[..., :2], start[..., :2])
        assert torch.equal(reference.refine(0, states, start)[..., :2], expected)
    assert len(expected.flatten(0, 1).unique(dim=0)) > 10


def assert_float32_coordinates(head) -> None:
    """Predict lines in bfloat16, in which points of a 60 m axis would be multiples of 0.2 m."""
    feats = torch.randn(1, C, 8, 4, generator=torch.Generator().manual_seed(1))
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        mean = head.eval().coordinate_feature()  # kept for later batches, in float32 or not
        points = head({"bev_feats": feats})[-1].references[..., :2]
    head.train()
    torch.testing.assert_close(mean, head.coordinate_feature().detach(), rtol=0, atol=0)
    assert points.dtype == torch.float32
    assert not torch.equal(points, points.bfloat16().float())
