"""Memory of queries: the best of a frame enter the decoder of the next, moved with the vehicle."""

from typing import Any

import torch
import torch.nn.functional as F
from mmdet3d.registry import MODELS
from mmengine.model import BaseModule
from torch import Tensor, nn
from torch.utils._pytree import tree_flatten, tree_unflatten

from gsmap.checkpoints.strict import AddsWeights
from gsmap.models.base.decoder import Queries
from gsmap.models.base.hooks import FlowHead, FlowHook
from gsmap.models.base.pairs import GroundTruth, MatchedPairs, Predictions
from gsmap.structures.past import Past
from gsmap.utils.errors import InputError

_POSE = 12  # the first three rows of a motion


@MODELS.register_module()
class QueryMemory(BaseModule, AddsWeights):
    """Hand on the best queries of each frame, for any head (StreamMapNet).

    A query's state is updated by a small network that knows the motion; its reference is moved. In
    the next frame they take the place of its weakest queries after the first decoder layer. In
    training an updated query must predict the moved target of the frame before.

    Args:
        embed_dims: Channels C of the queries.
        num: Queries that are handed on, K.
        loss_weight: Weight of that loss, 0.1 of the points' 50 as published.
        beta: Distance, [0, 1] over the map, below which smooth L1 is a parabola.
    """

    neutral_keys = ("fc.",)

    def __init__(
        self, embed_dims: int, num: int = 33, loss_weight: float = 5.0, beta: float = 0.01
    ) -> None:
        super().__init__()
        self.num, self.loss_weight, self.beta = num, loss_weight, beta
        self.fc = nn.Sequential(
            nn.Linear(embed_dims + _POSE, 2 * embed_dims),
            nn.LayerNorm(2 * embed_dims),
            nn.ReLU(),
            nn.Linear(2 * embed_dims, embed_dims),
        )

    def init_weights(self) -> None:
        """Let every query stay almost as it is."""
        super().init_weights()
        for layer in self.fc:
            if isinstance(layer, nn.Linear):
                nn.init.zeros_(layer.weight)

    def check(self, head: FlowHead) -> None:
        """Raise ValueError if the head predicts with too few queries, or in one layer."""
        if len(head.decoder.layers) < 2:
            raise InputError(
                "a memory of queries enters after the first decoder layer, and the head has no "
                "other: set map_head.decoder.num_layers to 2 or more."
            )
        own = head.query_groups[0].num
        if not 0 < self.num < own:
            raise InputError(
                f"a memory of {self.num} queries does not fit a head of {own}: set "
                "temporal.queries.num to less than its queries."
            )

    def update(self, states: Tensor, motion: Tensor) -> Tensor:
        """Tell states how the vehicle has moved, metres then to metres now. (B, ..., C)"""
        code = motion[:, :3].flatten(1).to(states).view(len(states), *[1] * (states.dim() - 2), -1)
        return states + self.fc(torch.cat([states, code.expand(*states.shape[:-1], -1)], -1))

    def moved(self, head: FlowHead, references: Tensor, past: Past) -> Tensor:
        """Return references of the frame before as they lie now. (B, K, P, D)"""
        return head.reference.moved(references, past.now_from_then)

    def fused(self, refined: Tensor, before: Tensor, head: FlowHead) -> Tensor:
        """Return the last layer's references of queries that were handed on. (B, K, P, D)

        ``refined`` is what the decoder has made of ``before``, what `moved` has returned.
        """
        return refined


def by_instance(leaf: Tensor, num: int) -> Tensor:
    """Sort queries by their instance, N of them. (B, Q, ...) -> (B, N, Q / N, ...)"""
    return leaf.unflatten(1, (num, -1))


def leaf_names(count: int) -> list[str]:
    """Return under which names `Queries` of so many leaves are kept: states, then references."""
    return [*(f"queries_{number}" for number in range(count - 1)), "references"]


def pick(values: Tensor, order: Tensor) -> Tensor:
    """Take instances in an order. (B, N, ...), (B, M) -> (B, M, ...)"""
    return values[torch.arange(len(order), device=order.device)[:, None], order]


class Propagation(FlowHook):
    """The memory of queries in one batch: what enters the decoder, and what is kept of it.

    Args:
        memory: Its settings and network.
        past: What the streams have left.
    """

    def __init__(self, memory: QueryMemory, past: Past) -> None:
        self.memory, self.past = memory, past
        self.handed_on: Queries | None = None  # what entered: leaves by instance (B, K, rows, ...)
        self.last: Queries | None = None
        self.total = 0  # queries N
        self.chosen: Tensor | None = None  # (B, K)
        self.matched: Tensor | None = None  # (B, N, P, 2 or 3)

    def refine(self, head: FlowHead, layer: int, refined: Tensor) -> Tensor:
        """Return the references after a layer, see `FlowHook`. (B, N * P, D)"""
        if layer < len(head.decoder.layers) - 1 or self.handed_on is None:
            return refined
        lines, before = head.decoder.by_instance(refined), self.handed_on.reference
        own = lines[:, : self.memory.num]
        fused = self.memory.fused(own, before, head)
        first = torch.where(self.past.continues.view(-1, 1, 1, 1), fused, own)
        return torch.cat([first, lines[:, self.memory.num :]], 1).flatten(1, 2)

    def between(self, head: FlowHead, layer: int, queries: Queries) -> Queries:
        """Let the memory enter after the first layer, and keep what the last layer returns."""
        if layer == len(head.decoder.layers) - 1:
            self.last = queries
        elif layer == 0 and self.past.memory:
            return self.insert(head, queries)
        return queries

    def insert(self, head: FlowHead, queries: Queries) -> Queries:
        """Return the queries with those of the memory first, in place of the weakest.

        A stream that starts keeps its queries as they are. Further query groups, of training, keep
        theirs too.
        """
        decoded = head.decoder.read(queries.state, queries.reference)
        total, own = decoded.instance_states.shape[1], head.query_groups[0].num
        with torch.no_grad():
            scores = head.cls_branches[0](decoded.instance_states[:, :own]).amax(-1)
        order = self.order(scores, total)
        leaves, form = tree_flatten(queries)
        names = leaf_names(len(leaves))
        entering = [
            self.past.memory[name].to(leaf.dtype) if isinstance(leaf, Tensor) else leaf
            for name, leaf in zip(names, leaves, strict=True)
        ]
        self.handed_on = self.moved(head, tree_unflatten(entering, form))
        merged: list[Any] = []
        for leaf, new in zip(leaves, tree_flatten(self.handed_on)[0], strict=True):
            if isinstance(leaf, Tensor):
                leaf = torch.cat([new.to(leaf.dtype), by_instance(leaf, total)], 1)
                leaf = pick(leaf, order).flatten(1, 2)
            merged.append(leaf)
        return tree_unflatten(merged, form)

    def order(self, scores: Tensor, total: int) -> Tensor:
        """Return the queries of the next layer: of the memory (0 to K - 1) or own (K on). (B, N)"""
        num, own = self.memory.num, scores.shape[1]
        survivors = scores.topk(own - num).indices + num
        first = torch.arange(num, device=scores.device).expand(len(scores), -1)
        stay = torch.arange(num, num + own, device=scores.device)
        changed = torch.cat([first, survivors], 1)
        order = torch.where(self.past.continues[:, None], changed, stay)
        further = torch.arange(num + own, num + total, device=scores.device)
        return torch.cat([order, further.expand(len(scores), -1)], 1)

    def moved(self, head: FlowHead, queries: Queries) -> Queries:
        """Update states and references of an earlier frame by the vehicle's motion."""
        dims = head.embed_dims
        leaves, form = tree_flatten(queries.state)
        leaves = [
            self.memory.update(leaf, self.past.now_from_then)
            if isinstance(leaf, Tensor) and leaf.shape[-1] == dims
            else leaf
            for leaf in leaves
        ]
        state = tree_unflatten(leaves, form)
        reference = self.memory.moved(head, queries.reference, self.past)
        return Queries(state, queries.position, reference)

    def outputs(self, head: FlowHead, layers: list[Predictions]) -> list[Predictions]:
        """Choose what is handed on by the class logits of the last layer."""
        scores = layers[-1].scores  # (B, N, classes)
        self.total = scores.shape[1]
        own = scores[:, : head.query_groups[0].num].detach()
        self.chosen = own.amax(-1).topk(self.memory.num).indices
        return layers

    def targets(self, head: FlowHead, pairs: MatchedPairs) -> None:
        """Keep what the queries of the last layer are matched to."""
        targets = torch.zeros_like(pairs.predictions.pts)
        targets[pairs.samples, pairs.query_inds] = pairs.gt_pts.to(targets)
        self.matched = targets

    def losses(self, head: FlowHead, truths: GroundTruth) -> dict[str, Tensor]:
        """Return the loss of the updated queries."""
        return {"loss_trans": self.loss(head)}

    def left(self) -> dict[str, Tensor]:
        """Return what the streams hand on, best first, by name. (B, K, rows, ...) each"""
        assert self.last is not None
        assert self.chosen is not None
        leaves = tree_flatten(self.last)[0]
        left = {
            name: pick(by_instance(leaf.detach(), self.total), self.chosen)
            for name, leaf in zip(leaf_names(len(leaves)), leaves, strict=True)
            if isinstance(leaf, Tensor)
        }
        if self.matched is not None:
            left["targets"] = pick(self.matched.detach(), self.chosen)
        return left

    def loss(self, head: FlowHead) -> Tensor:
        """Return the loss of the updated queries, 0 with a gradient of 0 if no stream continues."""
        stored = self.past.memory.get("targets")  # (B, K, P, 2 or 3)
        if self.handed_on is None or stored is None:
            return 0.0 * torch.stack([p.sum() for p in self.memory.parameters()]).sum()
        state, _, reference = self.handed_on
        state = tree_unflatten(*_flat_rows(state))
        pred = head.reference.refine(0, head.decoder.point_states(state), reference.flatten(1, 2))
        pred = pred[..., : stored.shape[-1]].reshape(stored.shape)
        target = head.reference.moved_points(stored, self.past.now_from_then)
        weight = (stored.flatten(2) != 0).any(-1) & self.past.continues[:, None]  # (B, K)
        each = F.smooth_l1_loss(pred, target, reduction="none", beta=self.memory.beta)
        total = (each.sum((-1, -2)) * weight).sum() / stored.shape[-2]
        return self.memory.loss_weight * total / (weight.sum() + 1e-10)


def _flat_rows(state: Any) -> tuple[list[Any], Any]:
    """Undo `by_instance` in all tensors of a state."""
    leaves, form = tree_flatten(state)
    flat = [leaf.flatten(1, 2) if isinstance(leaf, Tensor) else leaf for leaf in leaves]
    return flat, form
