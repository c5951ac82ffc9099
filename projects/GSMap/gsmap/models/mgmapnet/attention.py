"""MGMapNet's attention, in which an instance query and its point queries share BEV samples."""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from mmdet3d.registry import MODELS
from torch import Tensor, nn

from gsmap.models.base.attention import SamplingAttention, place_samples
from gsmap.models.base.layers import feed_forward, mlp
from gsmap.ops.deformable_sampling import deformable_sample
from gsmap.structures.tensors import at_least_float32
from gsmap.utils.errors import InputError


class Granularities(NamedTuple):
    """Queries of all map elements at both granularities, passed from layer to layer."""

    instances: Tensor  # instance queries (B, N, C)
    points: Tensor | None = None  # point queries, None before the first layer (B, N, P, C)
    point_code: Tensor | float = 0.0  # position codes of the points, or 0 (B, N, P, C)
    mean_locations: Tensor | None = None  # mean location of each point's samples (B, N, P, 2)


class Samples(NamedTuple):
    """Locations and weights of BEV samples. (B, N, P, levels, heads, K) each"""

    locations: Tensor  # (x, y) in [0, 1] over the map (..., 2)
    point_weights: Tensor  # sum to 1 over K
    weights: Tensor  # sum to 1 over P, levels and K


class PerPointSampling(SamplingAttention):
    """Base of the attentions that sample BEV features at K offsets around every point.

    Args:
        num_points: Points per instance P.
        num_samples: Samples K per head, level and point.
        num_levels: Number of levels of BEV features.
        kwargs: Arguments ``embed_dims`` C, ``num_heads`` and ``dropout`` of
            :class:`SamplingAttention`.
    """

    def __init__(
        self, num_points: int = 20, num_samples: int = 8, num_levels: int = 2, **kwargs: Any
    ) -> None:
        self.layout = (num_levels, num_points, num_samples)
        super().__init__(num_points=num_samples, num_parts=num_levels * num_points, **kwargs)

    def forward(
        self,
        state: Granularities,
        position: Tensor,
        reference: Tensor,
        feats: Sequence[Tensor],
        frames: Tensor | None = None,
    ) -> Granularities:
        """Update the queries from BEV features, residuals included.

        Args:
            state: Queries of the previous layer.
            position: Positional embeddings of the instances. (B, N, C)
            reference: References of the points, which begin with (x, y) in [0, 1] over the map.
                (B, N, P, D)
            feats: Levels of BEV features, the finest first. (B, C, H, W) each
            frames: Rotations of the offsets of each point, or None. (B, N * P, 2, 2)

        Returns:
            Updated queries.

        Raises:
            ValueError: If the number of levels or of points differs from the settings.
        """
        query = state.instances + position
        samples = self.compute_samples(query, reference, feats=feats, frames=frames)
        state = self.update(state, feats, samples=samples)
        return state._replace(mean_locations=samples.locations.mean(dim=(3, 4, 5)))

    def update(
        self, state: Granularities, feats: Sequence[Tensor], samples: Samples
    ) -> Granularities:
        """Update the queries from the sampled features.

        Args:
            state: Queries of the previous layer.
            feats: Levels of BEV features, the finest first. (B, C, H, W) each
            samples: Locations and weights of the samples.
        """
        raise NotImplementedError

    def compute_samples(
        self,
        query: Tensor,
        reference: Tensor,
        feats: Sequence[Tensor],
        frames: Tensor | None = None,
    ) -> Samples:
        """Compute the locations and the weights of the samples from the instance queries.

        Args:
            query: Instance queries plus their positional embeddings. (B, N, C)
            reference: References of the points, which begin with (x, y) in [0, 1] over the map.
                (B, N, P, D)
            feats: Levels of BEV features, the finest first. (B, C, H, W) each
            frames: Rotations of the offsets of each point, or None. (B, N * P, 2, 2)

        Raises:
            ValueError: If the number of levels or of points differs from the settings.
        """
        num_levels, num_points, _ = self.layout
        if len(feats) != num_levels or reference.shape[2] != num_points:
            raise InputError(
                f"expected {num_levels} levels of BEV features and {num_points} points per "
                f"instance, got {len(feats)} and {reference.shape[2]}."
            )
        offsets = self.offsets_in_cells(query).unflatten(-2, self.layout)
        offsets = offsets.permute(3, 0, 1, 4, 2, 5, 6)
        offsets = offsets.flatten(2, 3)  # (levels, B, N * P, heads, K, 2)
        point_references = reference.flatten(1, 2)  # (B, N * P, D)
        level_locations = []
        for level_offsets, level in zip(offsets, feats, strict=True):
            shape = (level.shape[-2], level.shape[-1])
            locations = place_samples(level_offsets, point_references, shape=shape, frames=frames)
            level_locations.append(locations)
        logits = at_least_float32(self.attention_weights(query))
        logits = logits.unflatten(-1, (self.num_heads, *self.layout))
        weights = logits.flatten(-3).softmax(dim=-1).unflatten(-1, self.layout)
        point_weights = logits.softmax(dim=-1)
        order = (0, 1, 4, 3, 2, 5)  # (B, N, heads, levels, P, K) -> (B, N, P, levels, heads, K)
        return Samples(
            locations=torch.stack(level_locations, dim=2).unflatten(1, (-1, num_points)),
            point_weights=point_weights.permute(order),
            weights=weights.permute(order),
        )

    def sample(self, feats: Sequence[Tensor], locations: Tensor, weights: Tensor) -> Tensor:
        """Sample each level and compute weighted sums.

        Args:
            feats: Levels of BEV features, the finest first. (B, C, H, W) each
            locations: Locations (x, y) in [0, 1] over the map. (B, Q, levels, heads, S, 2)
            weights: Weights of the samples. (B, Q, levels, heads, S)

        Returns:
            Weighted sums of each level and head. (B, Q, levels, heads, C / heads)
        """
        sums = []
        for number, level in enumerate(feats):
            level_sum = deformable_sample(
                self.values(level.flatten(2).transpose(1, 2)),
                (level.shape[-2], level.shape[-1]),
                locations=locations[:, :, number],
                weights=weights[:, :, number],
            )
            sums.append(level_sum)
        return torch.stack(sums, dim=2).unflatten(-1, (self.num_heads, -1))


@MODELS.register_module()
class MultiPointAttention(PerPointSampling):
    """Attention of instance queries alone around all of their points, as `LinePointAttention`.

    A linear layer computes the point queries from the instance query. This is the baseline of
    MGMapNet's tables.

    Args:
        embed_dims: Channels C.
        kwargs: Further arguments of :class:`PerPointSampling`.
    """

    def __init__(self, embed_dims: int = 256, **kwargs: Any) -> None:
        super().__init__(embed_dims=embed_dims, **kwargs)
        self.point_proj = nn.Linear(embed_dims, self.layout[1] * embed_dims)

    def update(
        self, state: Granularities, feats: Sequence[Tensor], samples: Samples
    ) -> Granularities:
        """Update the instance queries from the sampled features, and compute their points.

        Args:
            state: Queries of the previous layer.
            feats: Levels of BEV features, the finest first. (B, C, H, W) each
            samples: Locations and weights of the samples.
        """
        # (B, N, P, levels, heads, K, ...) -> (B, N, levels, heads, P * K, ...)
        locations = samples.locations.movedim(2, 4).flatten(4, 5)
        weights = samples.weights.movedim(2, 4).flatten(4, 5)
        features = self.sample(feats, locations, weights=weights).sum(dim=2)  # (B, N, heads, C')
        instances = state.instances + self.dropout(self.output_proj(features.flatten(2)))
        points = self.point_proj(instances).unflatten(-1, (self.layout[1], -1))
        return Granularities(instances, points)


@MODELS.register_module()
class MultiGranularityAttention(PerPointSampling):
    """Attention that samples for instance and point queries, which then interact (MGMapNet).

    Each part can be switched off, for the ablation tables of the paper.

    Args:
        embed_dims: Channels C.
        ffn_dims: Hidden channels of the interactions.
        add_instance: Whether the aggregated instance query is added to its points before P2I.
        p2p: Whether the points of an instance attend to each other and to their previous states.
        p2i: Whether points attend to all aggregated instance queries of the sample.
        position_codes: Whether codes of the sampling locations are added to queries and keys.
        kwargs: Further arguments of :class:`PerPointSampling`.
    """

    def __init__(
        self,
        embed_dims: int = 256,
        ffn_dims: int = 1024,
        add_instance: bool = True,
        p2p: bool = True,
        p2i: bool = True,
        position_codes: bool = True,
        **kwargs: Any,
    ) -> None:
        super().__init__(embed_dims=embed_dims, **kwargs)
        _, num_points, num_samples = self.layout
        interaction = partial(
            Interaction,
            embed_dims=embed_dims,
            num_heads=self.num_heads,
            ffn_dims=ffn_dims,
            dropout=self.dropout.p,
        )
        self.add_instance = add_instance
        self.p2p = interaction() if p2p else None
        self.p2i = interaction() if p2i else None
        self.point_code: nn.Sequential | None = None
        self.instance_code: nn.Sequential | None = None
        if position_codes and (p2p or p2i):
            self.point_code = mlp(2 * num_samples, embed_dims, embed_dims)
        if position_codes and p2i:
            self.instance_code = mlp(2 * num_points * num_samples, embed_dims, embed_dims)
        self.instance_mlp = mlp(num_points * embed_dims, embed_dims, embed_dims)

    def update(
        self, state: Granularities, feats: Sequence[Tensor], samples: Samples
    ) -> Granularities:
        """Update both kinds of queries from the sampled features and from each other.

        Args:
            state: Queries of the previous layer.
            feats: Levels of BEV features, the finest first. (B, C, H, W) each
            samples: Locations and weights of the samples.
        """
        instances, points = self.aggregate(feats, samples)
        point_code, instance_code = self.codes(samples)
        points = self.interact_points(points, point_code, before=state)
        if self.add_instance:
            points = points + instances[:, :, None]
        points = self.interact_instances(
            points, point_code, instances=instances, instance_code=instance_code
        )
        # Differs from the poster, which sums the points: the released model concatenates them.
        instances = state.instances + self.dropout(self.instance_mlp(points.flatten(2)))
        points = self.dropout(self.output_proj(points))
        if state.points is not None:
            points = points + state.points
        return Granularities(instances, points, point_code=point_code)

    def aggregate(self, feats: Sequence[Tensor], samples: Samples) -> tuple[Tensor, Tensor]:
        """Aggregate the sampled features to instance queries and point queries.

        The joint weight of a sample is its weight within the point times the share of the point and
        level in the instance, so an instance query is a weighted sum of the features of its points.

        Args:
            feats: Levels of BEV features, the finest first. (B, C, H, W) each
            samples: Locations and weights of the samples.

        Returns:
            Instance queries (B, N, C), and point queries averaged over the levels (B, N, P, C).
        """
        by_head = self.sample(
            feats,
            locations=samples.locations.flatten(1, 2),
            weights=samples.point_weights.flatten(1, 2),
        )
        by_head = by_head.unflatten(1, (-1, self.layout[1]))  # (B, N, P, levels, heads, C / heads)
        shares = samples.weights.sum(dim=-1)  # (B, N, P, levels, heads)
        instances = torch.einsum("bnplh,bnplhc->bnhc", shares, by_head)
        return instances.flatten(2), by_head.mean(dim=3).flatten(3)

    def codes(self, samples: Samples) -> tuple[Tensor | float, Tensor | float]:
        """Compute the position codes of points (B, N, P, C) and instances (B, N, C), or 0."""
        locations = samples.locations.mean(dim=(3, 4))  # (B, N, P, K, 2)
        point_code: Tensor | float = 0.0
        instance_code: Tensor | float = 0.0
        # Differs from the poster's MLP(S, W): the released model encodes their product.
        if self.point_code is not None:
            weighted_locations = locations * samples.point_weights.mean(dim=(3, 4))[..., None]
            point_code = self.point_code(weighted_locations.flatten(3))
        if self.instance_code is not None:
            weighted_locations = locations * samples.weights.mean(dim=(3, 4))[..., None]
            instance_code = self.instance_code(weighted_locations.flatten(2))
        return point_code, instance_code

    def interact_points(
        self, points: Tensor, code: Tensor | float, before: Granularities
    ) -> Tensor:
        """Attend from points to the points of their instance, now and in the previous layer.

        Args:
            points: Point queries. (B, N, P, C)
            code: Position codes of the points, or 0. (B, N, P, C)
            before: Queries of the previous layer.

        Returns:
            Updated point queries. (B, N, P, C)
        """
        if self.p2p is None:
            return points
        value = points
        query = points + code
        key = query
        # Differs from the poster, whose later layers attend to the previous points alone.
        if before.points is not None:
            value = torch.cat([before.points, value], dim=2)  # (B, N, 2 P, C)
            key = torch.cat([before.points + before.point_code, key], dim=2)
        updated_points = self.p2p(
            points.flatten(0, 1),
            query=query.flatten(0, 1),
            key=key.flatten(0, 1),
            value=value.flatten(0, 1),
        )
        return updated_points.unflatten(0, points.shape[:2])

    def interact_instances(
        self, points: Tensor, code: Tensor | float, instances: Tensor, instance_code: Tensor | float
    ) -> Tensor:
        """Attend from points to all aggregated instance queries of the sample.

        Args:
            points: Point queries. (B, N, P, C)
            code: Position codes of the points, or 0. (B, N, P, C)
            instances: Aggregated instance queries. (B, N, C)
            instance_code: Position codes of the instances, or 0. (B, N, C)

        Returns:
            Updated point queries. (B, N, P, C)
        """
        if self.p2i is None:
            return points
        query = (points + code).flatten(1, 2)  # (B, N * P, C)
        key = instances + instance_code
        updated_points = self.p2i(points.flatten(1, 2), query=query, key=key, value=instances)
        return updated_points.unflatten(1, points.shape[1:3])


class Interaction(nn.Module):
    """Attention and feed-forward network, each with residual and LayerNorm after it.

    Args:
        embed_dims: Channels C.
        num_heads: Number of attention heads.
        ffn_dims: Hidden channels of the feed-forward network.
        dropout: Probability of setting a value to zero in training, in [0, 1].
    """

    def __init__(self, embed_dims: int, num_heads: int, ffn_dims: int, dropout: float) -> None:
        super().__init__()
        self.attn = nn.MultiheadAttention(embed_dims, num_heads, dropout=dropout, batch_first=True)
        self.ffn = feed_forward(embed_dims, ffn_dims, dropout=dropout)
        self.norms = nn.ModuleList(nn.LayerNorm(embed_dims) for _ in range(2))
        self.dropout = nn.Dropout(dropout)

    def forward(self, content: Tensor, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """Update the content by attention.

        Args:
            content: Content, to which the attended values are added. (B, Q, C)
            query: Queries. (B, Q, C)
            key: Keys. (B, S, C)
            value: Values. (B, S, C)

        Returns:
            Updated content. (B, Q, C)
        """
        attention_output, _ = self.attn(query, key, value, need_weights=False)
        content = self.norms[0](content + self.dropout(attention_output))
        return self.norms[1](self.ffn(content))
