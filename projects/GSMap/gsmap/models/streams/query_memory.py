"""Memory of queries: the best queries of a frame are added to the decoder of the next frame."""

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

_POSE = 12  # entries of the first three rows of a transform


@MODELS.register_module()
class QueryMemory(BaseModule, AddsWeights):
    """Propagation of the best queries of a frame to the next, for any head (Yuan et al. 2024).

    A small network conditions the states of the queries on the ego motion, and the references of
    the queries are transformed. In the next frame, the propagated queries replace the weakest
    queries after the first decoder layer. A training loss compares their refined references with
    the transformed targets of the previous frame.

    Args:
        embed_dims: Channels C of the queries.
        num: Number K of propagated queries.
        loss_weight: Weight of the loss. The default is the published value: 0.1 times 50, which is
            the weight of the points loss.
        beta: Distance below which the smooth L1 loss is quadratic, as a fraction of the map.
    """

    # Prefixes of weights that a checkpoint may lack. With its initial weights, the network hardly
    # changes a state (`init_weights`).
    neutral_keys = ("fc.",)

    def __init__(
        self, embed_dims: int, num: int = 33, loss_weight: float = 5.0, beta: float = 0.01
    ) -> None:
        super().__init__()
        self.num = num
        self.loss_weight = loss_weight
        self.beta = beta
        self.fc = nn.Sequential(
            nn.Linear(embed_dims + _POSE, 2 * embed_dims),
            nn.LayerNorm(2 * embed_dims),
            nn.ReLU(),
            nn.Linear(2 * embed_dims, embed_dims),
        )

    def init_weights(self) -> None:
        """Initialise the network so that it hardly changes a state: all matrices are set to 0."""
        super().init_weights()
        for layer in self.fc:
            if isinstance(layer, nn.Linear):
                nn.init.zeros_(layer.weight)

    def check(self, head: FlowHead) -> None:
        """Raise ValueError if the head cannot have a memory of queries."""
        if head.decoder.has_query_masks:
            raise InputError(
                f"{type(head.decoder).__name__} has a mask for each of its own queries, so it can "
                "have no memory of queries: leave out temporal.queries."
            )
        if len(head.decoder.layers) < 2:
            raise InputError(
                "a memory of queries is inserted after the first decoder layer, but the head has "
                "no second layer: set map_head.decoder.num_layers to 2 or more."
            )
        num_queries = head.query_groups[0].num
        if not 0 < self.num < num_queries:
            raise InputError(
                f"a memory of {self.num} queries does not fit a head of {num_queries} queries: set "
                "temporal.queries.num to a smaller number than the queries of the head."
            )

    def update(self, states: Tensor, motion: Tensor) -> Tensor:
        """Condition states on the ego motion.

        Args:
            states: States of the previous frame. (B, ..., C)
            motion: Transform from the previous to the current frame, in metres. (B, 4, 4)

        Returns:
            States for the current frame. (B, ..., C)
        """
        code = motion[:, :3].flatten(1).to(states)  # (B, 12), type and device of the states
        while code.dim() < states.dim():
            code = code.unsqueeze(1)
        code = code.expand((*states.shape[:-1], -1))
        return states + self.fc(torch.cat([states, code], dim=-1))

    def transform_references(self, head: FlowHead, references: Tensor, past: Past) -> Tensor:
        """Transform references of the previous frame to the current frame.

        Args:
            head: The head.
            references: References of the previous frame. (B, K, P, D)
            past: Memory of the streams and the ego motion.

        Returns:
            References of the current frame. (B, K, P, D)
        """
        return head.reference.transform_references(references, past.now_from_then)

    def fuse_references(self, refined: Tensor, transformed: Tensor, head: FlowHead) -> Tensor:
        """Combine the references of propagated queries before and after the decoder.

        The base class returns ``refined``.

        Args:
            refined: References after the last layer. (B, K, P, D)
            transformed: Result of `transform_references`. (B, K, P, D)
            head: The head.

        Returns:
            The final references of the queries. (B, K, P, D)
        """
        return refined


def by_instance(leaf: Tensor, num: int) -> Tensor:
    """Group queries by ``num`` instances. (B, Q, ...) -> (B, num, Q / num, ...)"""
    return leaf.unflatten(1, (num, -1))


def leaf_names(count: int) -> list[str]:
    """Return the names of the leaves of `Queries`, under which the memory stores the tensors.

    `tree_flatten` lists the leaves of nested tuples in a fixed order: the tensors or numbers of the
    state, then the position, and last the references.

    Args:
        count: Number of leaves.
    """
    return [*(f"queries_{number}" for number in range(count - 1)), "references"]


def pick(values: Tensor, order: Tensor) -> Tensor:
    """Select instances by indices (B, M). (B, N, ...) -> (B, M, ...)"""
    samples = torch.arange(len(order), device=order.device)[:, None]  # (B, 1), beside (B, M)
    return values[samples, order]


class Propagation(FlowHook):
    """Memory of queries in one batch: propagation to the decoder, and storage of the best queries.

    Args:
        memory: Settings and network.
        past: Memory of the streams and the ego motion.
    """

    def __init__(self, memory: QueryMemory, past: Past) -> None:
        self.memory = memory
        self.past = past
        # Remembered queries, transformed to the current frame. Each of their tensors has the shape
        # (B, K, rows, ...): P rows if the tensor describes points, one if it describes instances.
        self.propagated: Queries | None = None
        self.last: Queries | None = None  # after the last layer
        self.num_queries = 0  # number N of instance queries of all groups
        self.best_inds: Tensor | None = None  # indices of the queries to remember (B, K)
        # Target points of each query of the first group; zeros for a query without a match.
        # (B, queries of this group, P, 2 or 3)
        self.target_pts: Tensor | None = None

    def refine(self, head: FlowHead, layer: int, refined: Tensor) -> Tensor:
        """Fuse the references of propagated queries after the last layer, see `FlowHook.refine`.

        Args:
            head: The head.
            layer: Index of the layer.
            refined: References of the layer. (B, N * P, D)

        Returns:
            References, with the fused ones of propagated queries. (B, N * P, D)
        """
        if layer < len(head.decoder.layers) - 1 or self.propagated is None:
            return refined
        instances = head.decoder.by_instance(refined)
        propagated = instances[:, : self.memory.num]
        fused = self.memory.fuse_references(
            refined=propagated, transformed=self.propagated.reference, head=head
        )
        propagated = torch.where(self.past.continues.view(-1, 1, 1, 1), fused, propagated)
        return torch.cat([propagated, instances[:, self.memory.num :]], dim=1).flatten(1, 2)

    def between(self, head: FlowHead, layer: int, queries: Queries) -> Queries:
        """Insert the memory after the first layer, and store the output of the last layer.

        Args:
            head: The head.
            layer: Index of the layer that has run.
            queries: Queries after the layer.

        Returns:
            Queries of the next layer.
        """
        if layer == len(head.decoder.layers) - 1:
            self.last = queries
        elif layer == 0 and self.past.memory:  # the memory is empty if all streams start
            return self.insert(head, queries)
        return queries

    def insert(self, head: FlowHead, queries: Queries) -> Queries:
        """Replace the weakest queries of the first group by the propagated queries.

        The propagated queries come first. A stream that starts keeps all its queries, and so do the
        further query groups of training.
        """
        decoded = head.decoder.read(queries.state, queries.reference)  # by instance
        total = decoded.instance_states.shape[1]
        group_size = head.query_groups[0].num
        with torch.no_grad():
            scores = head.cls_branches[0](decoded.instance_states[:, :group_size]).amax(-1)
        order = self.order(scores, total)  # indices into propagated and current queries (B, N)
        # A state may be a nested tuple. Its leaves are tensors or, in place of a tensor, a number
        # such as 0.0. Numbers are not stored in the memory.
        leaves, form = tree_flatten(queries)  # `form` rebuilds `Queries` from changed leaves
        remembered = []
        for name, leaf in zip(leaf_names(len(leaves)), leaves, strict=True):
            if isinstance(leaf, Tensor):
                leaf = self.past.memory[name].to(leaf.dtype)
            remembered.append(leaf)
        self.propagated = self.transform_queries(head, tree_unflatten(remembered, form))
        propagated_leaves, _ = tree_flatten(self.propagated)
        merged: list[Any] = []
        for leaf, propagated in zip(leaves, propagated_leaves, strict=True):
            if isinstance(leaf, Tensor):
                leaf = torch.cat([propagated.to(leaf.dtype), by_instance(leaf, total)], dim=1)
                leaf = pick(leaf, order).flatten(1, 2)  # again (B, Q, ...) as in `queries`
            merged.append(leaf)
        return tree_unflatten(merged, form)

    def order(self, scores: Tensor, total: int) -> Tensor:
        """Return the order of the queries of the next layer.

        In a stream that continues, the K propagated queries replace the K weakest queries of the
        first group. In a stream that starts, the current queries keep their order.

        Args:
            scores: Largest class logit of the queries of the first group. (B, N of the group)
            total: Number N of queries of all groups.

        Returns:
            Indices into the K propagated queries followed by the N current ones. (B, N)
        """
        num = self.memory.num
        group_size = scores.shape[1]
        # The propagated queries have the indices 0 to num - 1, and current query i has num + i.
        survivors = scores.topk(group_size - num).indices + num
        propagated = torch.arange(num, device=scores.device).expand(len(scores), -1)
        unchanged = torch.arange(num, num + group_size, device=scores.device)
        replaced = torch.cat([propagated, survivors], dim=1)
        order = torch.where(self.past.continues[:, None], replaced, unchanged)
        further = torch.arange(num + group_size, num + total, device=scores.device)
        return torch.cat([order, further.expand(len(scores), -1)], dim=1)

    def transform_queries(self, head: FlowHead, queries: Queries) -> Queries:
        """Transform states and references of the previous frame to the current frame."""
        leaves, form = tree_flatten(queries.state)
        states = []
        for leaf in leaves:
            # Leaves with another number of channels, such as sampling locations, are not states.
            if isinstance(leaf, Tensor) and leaf.shape[-1] == head.embed_dims:
                leaf = self.memory.update(leaf, self.past.now_from_then)
            states.append(leaf)
        reference = self.memory.transform_references(head, queries.reference, self.past)
        return Queries(
            state=tree_unflatten(states, form), position=queries.position, reference=reference
        )

    def outputs(self, head: FlowHead, layers: list[Predictions]) -> list[Predictions]:
        """Select the queries to remember by the class logits of the last layer."""
        scores = layers[-1].scores  # (B, N, classes)
        self.num_queries = scores.shape[1]
        group_scores = scores[:, : head.query_groups[0].num].detach()
        self.best_inds = group_scores.amax(-1).topk(self.memory.num).indices
        return layers

    def targets(self, head: FlowHead, pairs: MatchedPairs) -> None:
        """Store the matched targets of the queries of the last layer."""
        targets = torch.zeros_like(pairs.predictions.pts)
        # One row for each matched pair: its sample, its query and the points of its ground truth.
        targets[pairs.samples, pairs.query_inds] = pairs.gt_pts.to(targets)
        self.target_pts = targets

    def losses(self, head: FlowHead, truths: GroundTruth) -> dict[str, Tensor]:
        """Return the transformation loss of the propagated queries, by name."""
        return {"loss_trans": self.loss(head)}

    def collect_memory(self) -> dict[str, Tensor]:
        """Collect the memory for the next frame, by name. (B, K, rows, ...) each

        The K queries are in the order of falling scores.
        """
        assert self.last is not None
        assert self.best_inds is not None
        leaves, _ = tree_flatten(self.last)
        memory = {}
        for name, leaf in zip(leaf_names(len(leaves)), leaves, strict=True):
            if isinstance(leaf, Tensor):
                instances = by_instance(leaf.detach(), self.num_queries)
                memory[name] = pick(instances, self.best_inds)
        if self.target_pts is not None:
            memory["targets"] = pick(self.target_pts.detach(), self.best_inds)
        return memory

    def loss(self, head: FlowHead) -> Tensor:
        """Compute the transformation loss (Yuan et al. 2024).

        It is the smooth L1 distance between the refined references of the propagated queries and
        the transformed targets of the previous frame. If no stream continues, it is 0 with a
        gradient of 0.
        """
        previous = self.past.memory.get("targets")  # (B, K, P, 2 or 3)
        if self.propagated is None or previous is None:
            # Distributed training requires a gradient of every parameter in every step.
            sums = [parameter.sum() for parameter in self.memory.parameters()]
            return 0.0 * torch.stack(sums).sum()
        # The branch of the first layer refines the references of the propagated queries.
        state = _flatten_instances(self.propagated.state)
        pred = head.reference.refine(
            0,
            point_states=head.decoder.point_states(state),
            reference=self.propagated.reference.flatten(1, 2),
        )
        # The first entries of a reference are its coordinates. (B, K * P, D) -> (B, K, P, 2 or 3)
        pred = pred[..., : previous.shape[-1]].reshape(previous.shape)
        # Both are in [0, 1] over the map of the current frame.
        target = head.reference.transform_points(previous, self.past.now_from_then)
        has_target = (previous.flatten(2) != 0).any(-1)  # (B, K); unmatched queries have zeros
        weight = has_target & self.past.continues[:, None]
        distances = F.smooth_l1_loss(pred, target, reduction="none", beta=self.memory.beta)
        num_points = previous.shape[-2]
        total = (distances.sum((-1, -2)) * weight).sum() / num_points
        # The small number avoids a division by 0 if no query has a target.
        return self.memory.loss_weight * total / (weight.sum() + 1e-10)


def _flatten_instances(state: Any) -> Any:
    """Undo `by_instance` in all tensors of a state. (B, num, Q / num, ...) -> (B, Q, ...)"""
    leaves, form = tree_flatten(state)
    flat = []
    for leaf in leaves:
        flat.append(leaf.flatten(1, 2) if isinstance(leaf, Tensor) else leaf)
    return tree_unflatten(flat, form)
