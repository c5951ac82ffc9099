"""Hooks into a head's flow, by the example of denoising queries (DN-DETR) built outside of it."""

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
    elements,
)
from mmdet3d.registry import MODELS
from model_cases import make_samples
from torch import Tensor, nn

from gsmap.models.base.decoder import Queries
from gsmap.models.base.groups import QueryGroup
from gsmap.models.base.hooks import FlowHead, FlowHook, FlowStart
from gsmap.models.base.pairs import GroundTruth, Predictions
from gsmap.models.streams.query_memory import Propagation, QueryMemory
from gsmap.structures.past import Past

NOISED = "NoisedQueries"
SHAPES = {"loss_raster": None, "iou_cost": None}  # Gaussians without masks, which take long


@MODELS.register_module(NOISED)
class NoisedQueries(nn.Module):
    """Queries of noised ground truth, in groups, which must predict what they were made of.

    Args:
        embed_dims: Channels C of the queries.
        num_classes: Number of classes.
        groups: Number of groups; each has every ground truth of a sample at least once.
        noise: Standard deviation of the points' noise, of the map's sides.
        leaks: Let the head's own queries attend to them, which no training may do.
    """

    name = "dn"

    def __init__(
        self,
        embed_dims: int,
        num_classes: int,
        groups: int = 2,
        noise: float = 0.02,
        leaks: bool = False,
    ) -> None:
        super().__init__()
        self.label = nn.Embedding(num_classes, 2 * embed_dims)
        self.groups, self.noise, self.leaks = groups, noise, leaks

    def hook(self, head: FlowHead, truths: GroundTruth) -> "NoisedBatch":
        return NoisedBatch(self, truths)


class NoisedBatch(FlowHook):
    """The noised queries of one batch, M of a sample."""

    def __init__(self, part: NoisedQueries, truths: GroundTruth) -> None:
        self.part, self.truths = part, truths
        self.size = max(1, *truths.counts)  # queries of a group
        each = torch.arange(self.size * part.groups) % self.size
        self.gts = [each % max(count, 1) for count in truths.counts]
        self.layers: list[Predictions] = []

    def start(self, head: FlowHead, start: FlowStart) -> FlowStart:
        own = start.queries.state.shape[1] // P
        points, labels = self.noised()  # (B, M, P, 2), (B, M)
        code = self.part.label(labels)[:, :, None] + head.pts_embedding.weight
        position, state = code.flatten(1, 2).chunk(2, -1)  # (B, M * P, C)
        reference = head.reference.start(position)
        reference = torch.cat([points.flatten(1, 2), reference[..., points.shape[-1] :]], -1)
        further = Queries(state, position, reference)
        queries = Queries(
            *(torch.cat(both, 1) for both in zip(start.queries, further, strict=True))
        )
        return FlowStart(queries, self.mask(own, start.mask))

    def noised(self) -> tuple[Tensor, Tensor]:
        points, labels = [], []
        for index, gts in enumerate(self.gts):
            rows = self.truths.first[index] + gts
            if not self.truths.counts[index]:  # no ground truth: points in the middle, without one
                points.append(torch.full((len(gts), P, 2), 0.5))
                labels.append(torch.zeros_like(gts))
                continue
            clean = self.truths.first_pts[rows]
            noise = self.part.noise * torch.randn_like(clean)
            points.append((clean + noise).clamp(0.01, 0.99))
            labels.append(self.truths.labels[rows])
        return torch.stack(points), torch.stack(labels)

    def mask(self, own: int, mask: Tensor | None) -> Tensor:
        owner = torch.arange(self.part.groups).repeat_interleave(self.size)
        blocked = torch.zeros(own + len(owner), own + len(owner), dtype=torch.bool)
        if mask is not None:
            blocked[:own, :own] = mask
        blocked[:own, own:] = not self.part.leaks  # one-sided: noised queries see the head's
        blocked[own:, own:] = owner[:, None] != owner
        return blocked

    def outputs(self, head: FlowHead, layers: list[Predictions]) -> list[Predictions]:
        noised = self.size * self.part.groups
        own = layers[0].scores.shape[1] - noised
        self.layers = [layer.of_queries(slice(own, None)) for layer in layers]
        return [layer.of_queries(slice(own)) for layer in layers]

    def losses(self, head: FlowHead, truths: GroundTruth) -> dict[str, Tensor]:
        group = QueryGroup(self.size * self.part.groups, "dn", weight=0.5, losses=("cls", "pts"))
        matches = [
            (torch.arange(len(gts) if count else 0), gts[: len(gts) if count else 0])
            for gts, count in zip(self.gts, truths.counts, strict=True)
        ]
        return head.known_losses(group, self.layers, truths, matches)


def with_noise(config: dict = HEAD, **settings) -> nn.Module:
    """Return a head in training that has noised queries."""
    return build_head(config, flow_parts=[{"type": NOISED, **settings}]).train()


def step(head: nn.Module, *gts, hooks: tuple = ()) -> dict[str, Tensor]:
    """Return the losses of one batch after their gradients are computed."""
    torch.manual_seed(1)
    losses = head.loss(bev(len(gts)), make_samples(*gts), hooks)
    head.zero_grad()
    sum(value for name, value in losses.items() if "loss" in name).backward()
    return losses


@pytest.mark.parametrize("config", [HEAD, {**GSMAP, **SHAPES}], ids=["points", "Gaussians"])
def test_denoising_trains_a_step_of_samples_with_many_few_and_no_elements(config):
    head = with_noise(config)
    losses = step(head, LANES, elements(), elements(((-3, -20), (-3, 20)), labels=[1]))
    for name in ("loss_cls_dn", "loss_pts_dn", "d0.loss_cls_dn", "d0.loss_pts_dn"):
        assert losses[name] > 0, name
    assert "loss_dir_dn" not in losses
    assert (head.flow_parts["dn"].label.weight.grad.abs().sum(1) > 0).all()  # of every class


def without_noise(head: nn.Module, **settings) -> nn.Module:
    """Return a head of these weights without noised queries."""
    plain = build_head(HEAD, **settings).train()
    state = {name: value for name, value in head.state_dict().items() if "flow_parts" not in name}
    plain.load_state_dict(state)
    return plain


def test_only_a_mask_keeps_the_heads_queries_from_seeing_the_noised_ones():
    for leaks in (False, True):
        head = with_noise(leaks=leaks)
        plain, losses = step(without_noise(head), LANES), step(head, LANES)
        equal = [torch.allclose(losses[name], value, atol=1e-6) for name, value in plain.items()]
        assert all(equal) != leaks


@pytest.mark.parametrize("config", [HEAD, {**GSMAP, **SHAPES}], ids=["points", "Gaussians"])
def test_masked_queries_of_a_hook_do_not_change_predictions(config):
    for further in ([], [{"name": "one2many", "num": 6}]):
        head = build_head(config, query_groups=[{"num": N}, *further])
        assert_masks_hide_appended_queries(head)


def test_further_query_groups_are_trained_beside_the_noised_queries():
    groups = {"query_groups": [{"num": N}, {"name": "one2many", "num": 6, "repeats": 2}]}
    head = with_noise({**HEAD, **groups})
    plain, losses = step(without_noise(head, **groups), LANES), step(head, LANES)
    assert "loss_pts_one2many" in plain
    for name, value in plain.items():
        torch.testing.assert_close(losses[name], value, atol=1e-6, rtol=0)


def test_matches_are_those_that_the_queries_were_made_of():
    """Without noise, and with layers that move nothing, a query predicts its ground truth."""
    head = with_noise(noise=0.0)
    for branch in head.reference.branches:
        nn.init.zeros_(branch[-1].weight), nn.init.zeros_(branch[-1].bias)
    crossed = elements(((3, -20), (3, 20)), ((-3, -20), (-3, 20)), ((9, -20), (9, 20)))
    losses = step(head, LANES, crossed)
    assert losses["loss_pts"] > 1
    assert losses["loss_pts_dn"] < 1e-4


def test_prediction_is_as_without_the_part(monkeypatch):
    head = with_noise()
    step(head, LANES)
    monkeypatch.setattr(NoisedQueries, "hook", None)  # not to be called
    with torch.no_grad():
        (found,) = head.eval().predict(bev(), make_samples(LANES))
        (expected,) = without_noise(head).eval().predict(bev(), make_samples(LANES))
    for name in ("pts", "scores_3d", "labels_3d"):
        assert torch.equal(found[name], expected[name]), name


def test_memory_and_noised_queries_take_part_in_one_flow():
    head = with_noise()
    memory = QueryMemory(embed_dims=head.embed_dims, num=3)  # one is matched
    nothing = torch.eye(4).double()[None], torch.zeros(1).double()
    first = Propagation(memory, Past({}, *nothing, torch.tensor([False])))
    step(head, LANES, hooks=(first,))
    left = {name: value.detach() for name, value in first.collect_memory().items()}
    second = Propagation(memory, Past(left, *nothing, torch.tensor([True])))
    losses = step(head, LANES, hooks=(second,))
    assert losses["loss_trans"] > 0
    assert losses["loss_pts_dn"] > 0
    assert second.num_queries == N + 4  # two groups of two ground truths
    assert second.best_inds.max() < N


def test_two_parts_of_one_name_are_refused():
    with pytest.raises(ValueError, match="two parts have one name, 'dn'"):
        build_head(HEAD, flow_parts=[{"type": NOISED}, {"type": NOISED}])
