"""MGMapNet's attention, in which instance and point queries share their BEV samples."""

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
    """Instance and point queries of all map elements, passed from layer to layer.

    The positional codes are computed from the sampling locations. The loss of sampling locations
    reads the mean locations.
    """

    instances: Tensor  # instance queries (B, N, C)
    points: Tensor | None = None  # point queries, None before the first layer (B, N, P, C)
    point_code: Tensor | float = 0.0  # position codes of the points (B, N, P, C), or 0 for none
    mean_locations: Tensor | None = None  # mean location of each point's samples (B, N, P, 2)


class Samples(NamedTuple):
    """Locations and weights of K BEV samples per point, level and head.

    Both kinds of weights are softmax functions of equal logits, over different axes.
    """

    locations: Tensor  # (x, y) in [0, 1] over the map (B, N, P, levels, heads, K, 2)
    point_weights: Tensor  # weights for points, with sum 1 over K (B, N, P, levels, heads, K)
    # Weights for instances, with sum 1 over P, levels and K (B, N, P, levels, heads, K)
    weights: Tensor


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
        self.sample_shape = (num_levels, num_points, num_samples)
        self.points_per_instance = num_points
        # `SamplingAttention` calls the K samples of a point "points". Every point on every level is
        # one of its "parts", which have equal initial offsets.
        super().__init__(num_points=num_samples, num_parts=num_levels * num_points, **kwargs)

    def forward(
        self,
        state: Granularities,
        position: Tensor,
        reference: Tensor,
        feats: Sequence[Tensor],
        frames: Tensor | None = None,
        mask: Tensor | None = None,
    ) -> Granularities:
        """Update the queries from BEV features, residuals included.

        Args:
            state: Queries of the previous layer.
            position: Positional embeddings of the instances. (B, N, C)
            reference: References of the points, which begin with (x, y) in [0, 1] over the map.
                (B, N, P, D)
            feats: Levels of BEV features, the finest first. (B, C, H, W) each
            frames: Rotations of the offsets of each point, or None. (B, N * P, 2, 2)
            mask: True where the points of an instance (row) may not attend to another instance
                (column), or None. (N, N)

        Returns:
            Updated queries, with the mean locations of their samples.

        Raises:
            ValueError: If the number of levels or of points differs from the settings.
        """
        query = state.instances + position
        samples = self.compute_samples(query, reference, feats=feats, frames=frames)
        state = self.update(state, feats, samples=samples, mask=mask)
        mean_locations = samples.locations.mean(dim=(3, 4, 5))  # (B, N, P, 2)
        return state._replace(mean_locations=mean_locations)

    def update(
        self,
        state: Granularities,
        feats: Sequence[Tensor],
        samples: Samples,
        mask: Tensor | None = None,
    ) -> Granularities:
        """Update the queries from the sampled features, residuals included.

        Args:
            state: Queries of the previous layer.
            feats: Levels of BEV features, the finest first. (B, C, H, W) each
            samples: Locations and weights of the samples.
            mask: True where the points of an instance (row) may not attend to another instance
                (column), or None. (N, N)

        Returns:
            Updated queries. `forward` adds their mean locations.
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
        num_levels, num_points, _ = self.sample_shape
        if len(feats) != num_levels or reference.shape[2] != num_points:
            raise InputError(
                f"expected {num_levels} levels of BEV features and {num_points} points per "
                f"instance, got {len(feats)} and {reference.shape[2]}."
            )
        # The base class returns all offsets of a head in one axis, in cells of their level.
        offsets = self.offsets_in_cells(query).unflatten(-2, self.sample_shape)
        # (B, N, heads, levels, P, K, 2) -> (levels, B, N, P, heads, K, 2)
        offsets = offsets.permute(3, 0, 1, 4, 2, 5, 6)
        offsets = offsets.flatten(2, 3)  # (levels, B, N * P, heads, K, 2)
        point_references = reference.flatten(1, 2)  # (B, N * P, D)
        level_locations = []  # (B, N * P, heads, K, 2) each
        for level_offsets, level in zip(offsets, feats, strict=True):
            height, width = level.shape[-2:]
            locations = place_samples(
                level_offsets, point_references, shape=(height, width), frames=frames
            )
            level_locations.append(locations)
        logits = at_least_float32(self.attention_weights(query))
        logits = logits.unflatten(-1, (self.num_heads, *self.sample_shape))
        point_weights = logits.softmax(dim=-1)
        weights = logits.flatten(-3).softmax(dim=-1)  # one softmax over levels, P and K
        weights = weights.unflatten(-1, self.sample_shape)
        order = (0, 1, 4, 3, 2, 5)  # (B, N, heads, levels, P, K) -> (B, N, P, levels, heads, K)
        return Samples(
            locations=torch.stack(level_locations, dim=2).unflatten(1, (-1, num_points)),
            point_weights=point_weights.permute(order),
            weights=weights.permute(order),
        )

    def sample(self, feats: Sequence[Tensor], locations: Tensor, weights: Tensor) -> Tensor:
        """Sample each level and compute weighted sums over S samples of each query.

        Args:
            feats: Levels of BEV features, the finest first. (B, C, H, W) each
            locations: Locations (x, y) in [0, 1] over the map. (B, Q, levels, heads, S, 2)
            weights: Weights of the samples. (B, Q, levels, heads, S)

        Returns:
            Weighted sums of each level and head. (B, Q, levels, heads, C / heads)
        """
        sums = []
        for index, level in enumerate(feats):
            cells = level.flatten(2).transpose(1, 2)  # (B, H * W, C)
            height, width = level.shape[-2:]
            level_sum = deformable_sample(
                self.values(cells),
                (height, width),
                locations=locations[:, :, index],
                weights=weights[:, :, index],
            )
            sums.append(level_sum)
        return torch.stack(sums, dim=2).unflatten(-1, (self.num_heads, -1))


@MODELS.register_module()
class MultiPointAttention(PerPointSampling):
    """Attention that updates only the instance queries, from samples around all of their points.

    A linear layer computes the point queries from the instance query. This attention is the
    baseline in the tables of MGMapNet. It corresponds to `LinePointAttention`.

    Args:
        embed_dims: Channels C.
        kwargs: Further arguments of :class:`PerPointSampling`.
    """

    def __init__(self, embed_dims: int = 256, **kwargs: Any) -> None:
        super().__init__(embed_dims=embed_dims, **kwargs)
        self.point_proj = nn.Linear(embed_dims, self.points_per_instance * embed_dims)

    def update(
        self,
        state: Granularities,
        feats: Sequence[Tensor],
        samples: Samples,
        mask: Tensor | None = None,
    ) -> Granularities:
        """Update the instance queries from the sampled features, and compute their points.

        Args:
            state: Queries of the previous layer.
            feats: Levels of BEV features, the finest first. (B, C, H, W) each
            samples: Locations and weights of the samples.
            mask: Not used, because instances do not attend to each other.
        """
        # (B, N, P, levels, heads, K, ...) -> (B, N, levels, heads, P * K, ...)
        locations = samples.locations.movedim(2, 4).flatten(4, 5)
        weights = samples.weights.movedim(2, 4).flatten(4, 5)
        features = self.sample(feats, locations, weights=weights)
        features = features.sum(dim=2)  # over the levels (B, N, heads, C / heads)
        instances = state.instances + self.dropout(self.output_proj(features.flatten(2)))
        points = self.point_proj(instances).unflatten(-1, (self.points_per_instance, -1))
        return Granularities(instances, points)


@MODELS.register_module()
class MultiGranularityAttention(PerPointSampling):
    """Attention that samples for instance and point queries, which then interact (MGMapNet).

    Each part can be switched off, for the ablation tables of the paper.

    Args:
        embed_dims: Channels C.
        ffn_dims: Hidden channels of the interactions.
        add_instance: Whether the aggregated instance query, the weighted sum of its samples, is
            added to its points before they attend to instance queries.
        p2p: Whether the points of an instance attend to each other and to their states of the
            previous layer (point to point).
        p2i: Whether points attend to the aggregated instance queries of the sample (point to
            instance).
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
        _, num_points, num_samples = self.sample_shape
        # Each call creates a new module, so `p2p` and `p2i` share no weights.
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
        attends = p2p or p2i  # without attention, codes would have no effect
        if position_codes and attends:
            self.point_code = mlp(2 * num_samples, embed_dims, embed_dims)
        if position_codes and p2i:
            self.instance_code = mlp(2 * num_points * num_samples, embed_dims, embed_dims)
        self.instance_mlp = mlp(num_points * embed_dims, embed_dims, embed_dims)

    def update(
        self,
        state: Granularities,
        feats: Sequence[Tensor],
        samples: Samples,
        mask: Tensor | None = None,
    ) -> Granularities:
        """Update both kinds of queries from the sampled features and from each other.

        Args:
            state: Queries of the previous layer.
            feats: Levels of BEV features, the finest first. (B, C, H, W) each
            samples: Locations and weights of the samples.
            mask: True where the points of an instance (row) may not attend to another instance
                (column), or None. (N, N)
        """
        instances, points = self.aggregate(feats, samples)
        point_code, instance_code = self.codes(samples)
        points = self.attend_to_points(points, point_code, previous=state)
        if self.add_instance:
            points = points + instances[:, :, None]
        points = self.attend_to_instances(
            points, point_code, instances=instances, instance_code=instance_code, mask=mask
        )
        # Differs from the poster of the paper, which sums the points: the released model
        # concatenates them.
        instances = state.instances + self.dropout(self.instance_mlp(points.flatten(2)))
        points = self.dropout(self.output_proj(points))
        if state.points is not None:
            points = points + state.points
        return Granularities(instances, points, point_code=point_code)

    def aggregate(self, feats: Sequence[Tensor], samples: Samples) -> tuple[Tensor, Tensor]:
        """Aggregate the sampled features to instance queries and point queries.

        Both kinds of weights are softmax functions of equal logits, over different axes. The share
        of a point and level is the sum over K of the weights for instances. The weight of a sample
        for its instance is this share times the weight of the sample for its point. An instance
        query is therefore the sum of the point features, weighted by their shares. So the features
        are sampled only once.

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
        # The shape becomes (B, N, P, levels, heads, C / heads).
        by_head = by_head.unflatten(1, (-1, self.points_per_instance))
        shares = samples.weights.sum(dim=-1)  # (B, N, P, levels, heads)
        # In the indices, p is the point, l the level, h the head and c the channel of a head.
        instances = torch.einsum("bnplh,bnplhc->bnhc", shares, by_head)
        return instances.flatten(2), by_head.mean(dim=3).flatten(3)

    def codes(self, samples: Samples) -> tuple[Tensor | float, Tensor | float]:
        """Compute the position codes of points (B, N, P, C) and instances (B, N, C), or 0."""
        locations = samples.locations.mean(dim=(3, 4))  # over levels and heads (B, N, P, K, 2)
        point_code: Tensor | float = 0.0
        instance_code: Tensor | float = 0.0
        # Differs from the poster, which encodes locations and weights as two inputs of the MLP: the
        # released model encodes their product.
        if self.point_code is not None:
            point_weights = samples.point_weights.mean(dim=(3, 4))  # (B, N, P, K)
            weighted_locations = locations * point_weights[..., None]
            point_code = self.point_code(weighted_locations.flatten(3))
        if self.instance_code is not None:
            weights = samples.weights.mean(dim=(3, 4))  # (B, N, P, K)
            weighted_locations = locations * weights[..., None]
            instance_code = self.instance_code(weighted_locations.flatten(2))
        return point_code, instance_code

    def attend_to_points(
        self, points: Tensor, code: Tensor | float, previous: Granularities
    ) -> Tensor:
        """Attend from points to the points of their instance, of this and of the previous layer.

        Args:
            points: Point queries. (B, N, P, C)
            code: Position codes of the points, or 0. (B, N, P, C)
            previous: Queries of the previous layer.

        Returns:
            Updated point queries. (B, N, P, C)
        """
        if self.p2p is None:
            return points
        value = points
        query = points + code
        key = query
        # Differs from the poster, whose later layers attend to the previous points alone.
        if previous.points is not None:
            value = torch.cat([previous.points, value], dim=2)  # (B, N, 2 P, C)
            key = torch.cat([previous.points + previous.point_code, key], dim=2)
        updated_points = self.p2p(
            points.flatten(0, 1),
            query=query.flatten(0, 1),
            key=key.flatten(0, 1),
            value=value.flatten(0, 1),
        )
        return updated_points.unflatten(0, points.shape[:2])

    def attend_to_instances(
        self,
        points: Tensor,
        code: Tensor | float,
        instances: Tensor,
        instance_code: Tensor | float,
        mask: Tensor | None = None,
    ) -> Tensor:
        """Attend from points to the aggregated instance queries of the sample.

        Args:
            points: Point queries. (B, N, P, C)
            code: Position codes of the points, or 0. (B, N, P, C)
            instances: Aggregated instance queries. (B, N, C)
            instance_code: Position codes of the instances, or 0. (B, N, C)
            mask: True where the points of an instance (row) do not attend to another instance
                (column), or None. (N, N)

        Returns:
            Updated point queries. (B, N, P, C)
        """
        if self.p2i is None:
            return points
        query = (points + code).flatten(1, 2)  # (B, N * P, C)
        key = instances + instance_code
        if mask is not None:
            mask = mask.repeat_interleave(points.shape[2], dim=0)  # (N * P, N)
        updated_points = self.p2i(
            points.flatten(1, 2), query=query, key=key, value=instances, mask=mask
        )
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

    def forward(
        self,
        content: Tensor,
        query: Tensor,
        key: Tensor,
        value: Tensor,
        mask: Tensor | None = None,
    ) -> Tensor:
        """Update the content by attention.

        Args:
            content: Content, to which the attended values are added. (B, Q, C)
            query: Queries. (B, Q, C)
            key: Keys. (B, S, C)
            value: Values. (B, S, C)
            mask: True where a query (row) does not attend to a key (column), or None. (Q, S)

        Returns:
            Updated content. (B, Q, C)
        """
        attention_output, _ = self.attn(query, key, value, attn_mask=mask, need_weights=False)
        content = self.norms[0](content + self.dropout(attention_output))
        return self.norms[1](self.ffn(content))
