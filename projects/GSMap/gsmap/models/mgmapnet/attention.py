"""MGMapNet's attention: one sampling of the BEV serves an instance query and its point queries."""

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
    """The queries of all map elements at both granularities, as layers hand them on."""

    instances: Tensor  # (B, N, C)
    points: Tensor | None = None  # none before the first layer (B, N, P, C)
    point_code: Tensor | float = 0.0  # position code (B, N, P, C), 0 without codes
    mean_locations: Tensor | None = None  # of each point's samples (B, N, P, 2)


class Samples(NamedTuple):
    """Where an attention looks, and how it weighs it: (B, N, P, levels, heads, K) each."""

    locations: Tensor  # sampling points (x, y), [0, 1] over the map (..., 2)
    point_weights: Tensor  # of sum one over K
    weights: Tensor  # of sum one over P, levels and K


class PerPointSampling(SamplingAttention):
    """What both attentions of this module share: the BEV sampled at K offsets around every point.

    Args:
        num_points: Points per instance P.
        num_samples: Samples per head, level and point K.
        num_levels: Levels of BEV features.
        kwargs: ``embed_dims`` C, ``num_heads`` and ``dropout`` as in :class:`SamplingAttention`.
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
        """Update the queries from the BEV, residuals included.

        Points and their code are those of the layer before. Instances have a position (B, N, C),
        points references (B, N, P, D) and frames (B, N * P, 2, 2), as in `place_samples`; features
        are levels x (B, C, H, W), the finest first. ValueError if the numbers of levels or points
        are not the module's.
        """
        samples = self.look(state.instances + position, reference, feats, frames)
        updated = self.update(state, feats, samples)
        return updated._replace(mean_locations=samples.locations.mean((3, 4, 5)))

    def update(
        self, state: Granularities, feats: Sequence[Tensor], samples: Samples
    ) -> Granularities:
        """Return the queries, updated by what the samples see."""
        raise NotImplementedError

    def look(
        self,
        query: Tensor,
        reference: Tensor,
        feats: Sequence[Tensor],
        frames: Tensor | None = None,
    ) -> Samples:
        """Place and weigh the samples of instance queries (B, N, C) with their position added."""
        levels, points, _ = self.layout
        if len(feats) != levels or reference.shape[2] != points:
            raise InputError(
                f"expected {levels} levels of BEV features and {points} points per instance, got "
                f"{len(feats)} and {reference.shape[2]}."
            )
        offsets = self.offsets_in_cells(query).unflatten(-2, self.layout)
        offsets = offsets.permute(3, 0, 1, 4, 2, 5, 6).flatten(2, 3)  # (levels, B, N P, heads, K,2)
        locations = [
            place_samples(by_level, reference.flatten(1, 2), (f.shape[-2], f.shape[-1]), frames)
            for by_level, f in zip(offsets, feats, strict=True)
        ]
        logits = at_least_float32(self.attention_weights(query))
        logits = logits.unflatten(-1, (self.num_heads, *self.layout))
        joint = logits.flatten(-3).softmax(-1).unflatten(-1, self.layout)
        order = (0, 1, 4, 3, 2, 5)  # (B, N, heads, levels, P, K) -> (B, N, P, levels, heads, K)
        return Samples(
            torch.stack(locations, 2).unflatten(1, (-1, points)),
            logits.softmax(-1).permute(order),
            joint.permute(order),
        )

    def sample(self, feats: Sequence[Tensor], locations: Tensor, weights: Tensor) -> Tensor:
        """Return weighted sums of each level, for locations (B, Q, levels, heads, S, 2) in it.

        Weights have the locations' shape without its last entry. (B, Q, levels, heads, C / heads)
        """
        seen = []
        for level, f in enumerate(feats):
            value, shape = self.values(f.flatten(2).transpose(1, 2)), (f.shape[-2], f.shape[-1])
            seen.append(
                deformable_sample(value, shape, locations[:, :, level], weights[:, :, level])
            )
        return torch.stack(seen, 2).unflatten(-1, (self.num_heads, -1))


@MODELS.register_module()
class MultiPointAttention(PerPointSampling):
    """Instance queries alone look around all of their points (StreamMapNet).

    The point queries follow from the instance query by one matrix, as StreamMapNet's points do.
    This is the baseline of MGMapNet's tables. Arguments as in :class:`PerPointSampling`.
    """

    def __init__(self, embed_dims: int = 256, **kwargs: Any) -> None:
        super().__init__(embed_dims=embed_dims, **kwargs)
        self.point_proj = nn.Linear(embed_dims, self.layout[1] * embed_dims)

    def update(
        self, state: Granularities, feats: Sequence[Tensor], samples: Samples
    ) -> Granularities:
        """Return the instance queries with what they see, and their points."""
        # (B, N, P, levels, heads, K, ...) -> (B, N, levels, heads, P * K, ...)
        locations = samples.locations.movedim(2, 4).flatten(4, 5)
        seen = self.sample(feats, locations, samples.weights.movedim(2, 4).flatten(4, 5)).sum(2)
        instances = state.instances + self.dropout(self.output_proj(seen.flatten(2)))
        points = self.point_proj(instances).unflatten(-1, (self.layout[1], -1))
        return Granularities(instances, points)


@MODELS.register_module()
class MultiGranularityAttention(PerPointSampling):
    """An aggregated instance query and its P point queries, which then interact (MGMapNet).

    Each part has its switch, for the ablation tables of the paper.

    Args:
        embed_dims: Channels C.
        ffn_dims: Hidden channels of the interactions.
        add_instance: Add the aggregated instance query to its points, before P2I.
        p2p: Let an instance's points attend to each other and to those of the layer before.
        p2i: Let the points attend to all aggregated instance queries of the sample.
        position_codes: Add codes of the sampling locations to queries and keys of both.
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
        _, points, samples = self.layout
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
        dims = (embed_dims, embed_dims)
        coded = position_codes and (p2p or p2i)
        self.point_code = mlp(2 * samples, *dims) if coded else None
        self.instance_code = mlp(2 * points * samples, *dims) if coded and p2i else None
        self.instance_mlp = mlp(points * embed_dims, *dims)

    def update(
        self, state: Granularities, feats: Sequence[Tensor], samples: Samples
    ) -> Granularities:
        """Return both queries after they have seen the BEV and each other."""
        instances, points = self.aggregate(feats, samples)
        point_code, instance_code = self.codes(samples)
        points = self.interact_points(points, point_code, state)
        if self.add_instance:
            points = points + instances[:, :, None]
        points = self.interact_instances(points, point_code, instances, instance_code)
        # Differs from the poster, which sums the points: the released model concatenates them.
        instances = state.instances + self.dropout(self.instance_mlp(points.flatten(2)))
        points = self.dropout(self.output_proj(points))
        if state.points is not None:
            points = points + state.points
        return Granularities(instances, points, point_code)

    def aggregate(self, feats: Sequence[Tensor], samples: Samples) -> tuple[Tensor, Tensor]:
        """Sum the samples to instance queries (B, N, C) and, mean over levels, points (B, N, P, C).

        The joint weights are the points' weights times the share that each point and level has in
        the instance, so the instance query is a weighted sum of what its points saw.
        """
        by_point = samples.locations.flatten(1, 2), samples.point_weights.flatten(1, 2)
        by_head = self.sample(feats, *by_point).unflatten(1, (-1, self.layout[1]))
        shares = samples.weights.sum(-1)  # (B, N, P, levels, heads)
        instances = torch.einsum("bnplh,bnplhc->bnhc", shares, by_head)
        return instances.flatten(2), by_head.mean(3).flatten(3)

    def codes(self, samples: Samples) -> tuple[Tensor | float, Tensor | float]:
        """Return the position codes of points (B, N, P, C) and instances (B, N, C), 0 for none."""
        locations = samples.locations.mean((3, 4))  # (B, N, P, K, 2)
        point_code = instance_code = 0.0
        # Differs from the poster's MLP(S, W): the released model codes their product.
        if self.point_code is not None:
            weighted = locations * samples.point_weights.mean((3, 4))[..., None]
            point_code = self.point_code(weighted.flatten(3))
        if self.instance_code is not None:
            weighted = locations * samples.weights.mean((3, 4))[..., None]
            instance_code = self.instance_code(weighted.flatten(2))
        return point_code, instance_code

    def interact_points(
        self, points: Tensor, code: Tensor | float, before: Granularities
    ) -> Tensor:
        """Let points attend to their instance's, now and in the layer before. (B, N, P, C)"""
        if self.p2p is None:
            return points
        value = points
        query = key = points + code
        # Differs from the poster, whose later layers attend to the points of the layer before only.
        if before.points is not None:
            value = torch.cat([before.points, value], 2)  # (B, N, 2 P, C)
            key = torch.cat([before.points + before.point_code, key], 2)
        flat = [x.flatten(0, 1) for x in (points, query, key, value)]
        return self.p2p(*flat).unflatten(0, points.shape[:2])

    def interact_instances(
        self, points: Tensor, code: Tensor | float, instances: Tensor, instance_code: Tensor | float
    ) -> Tensor:
        """Let all points of a sample attend to its aggregated instance queries. (B, N, P, C)"""
        if self.p2i is None:
            return points
        query, key = (points + code).flatten(1, 2), instances + instance_code
        attended = self.p2i(points.flatten(1, 2), query, key, instances)
        return attended.unflatten(1, points.shape[1:3])


class Interaction(nn.Module):
    """Attention and feed-forward network, each with residual and LayerNorm after it."""

    def __init__(self, embed_dims: int, num_heads: int, ffn_dims: int, dropout: float) -> None:
        super().__init__()
        self.attn = nn.MultiheadAttention(embed_dims, num_heads, dropout, batch_first=True)
        self.ffn = feed_forward(embed_dims, ffn_dims, dropout)
        self.norms = nn.ModuleList(nn.LayerNorm(embed_dims) for _ in range(2))
        self.dropout = nn.Dropout(dropout)

    def forward(self, content: Tensor, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """Update the content (B, Q, C) from keys and values (B, S, C). -> (B, Q, C)"""
        attended = self.attn(query, key, value, need_weights=False)[0]
        return self.norms[1](self.ffn(self.norms[0](content + self.dropout(attended))))
