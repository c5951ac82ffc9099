"""MGMap's decoder: masks activate the queries, layers look at four levels, patches refine."""

from dataclasses import dataclass, replace
from typing import Any

import torch
from mmdet3d.registry import MODELS
from mmengine.model import ModuleList
from torch import Tensor, nn

from gsmap.models.base.attention import MultiLevelAttention
from gsmap.models.base.decoder import Decoded, MapDecoder, Refine
from gsmap.models.maptr.self_attention import mask_of_points
from gsmap.models.mgmap.neck import EnhancedNeck
from gsmap.models.mgmap.refinement import (
    BINS,
    MaskFeature,
    PatchRefinement,
    mask_network,
    patches_around,
)
from gsmap.utils.errors import InputError


@dataclass(eq=False)
class MaskedDecoded(Decoded):
    """What a decoder layer returns, with the masks that activated the queries."""

    mask_logits: Tensor  # of the instances, the same in all layers (B, N, H, W)


@dataclass(eq=False)
class RefinedDecoded(Decoded):
    """What a stage of the refinement returns."""

    segmentation: Tensor  # logits of elements and of background, of all instances (B, 2, H, W)

    def of_queries(self, queries: slice) -> Decoded:
        """Return what belongs to some of the instance queries; the segmentation to all."""
        plain = Decoded(self.point_states, self.references, self.instance_states)
        return replace(self, **vars(plain.of_queries(queries)))


@MODELS.register_module()
class MGMapDecoder(MapDecoder):
    """MapTR's decoder on enhanced BEV features, with activated queries and a refinement (MGMap).

    Args:
        layer: Config of the layer (`MapDecoderLayer` with `MultiLevelAttention`).
        embed_dims: Channels C.
        num_masks: Instance queries of all groups, each with its mask.
        patches: Show the refinement a patch around each point. The released model shows it zeros,
            so that every point is corrected alike.
        refinements: Stages of the refinement; they use the branches of the last layers.
        refine_ffn_dims: Hidden channels of its feed-forward networks.
        kwargs: Further arguments of `MapDecoder`.

    Raises:
        ValueError: If there are less than no refinements, or more than layers.
    """

    def __init__(
        self,
        layer: dict[str, Any] | None = None,
        embed_dims: int = 256,
        num_masks: int = 50,
        patches: bool = False,
        refinements: int = 2,
        refine_ffn_dims: int = 1024,
        **kwargs: Any,
    ) -> None:
        layer = layer or {}
        levels = {"type": MultiLevelAttention, "num_levels": EnhancedNeck.num_levels}
        layer = {**layer, "cross_attn": {**levels, **layer.get("cross_attn", {})}}
        super().__init__(layer, embed_dims=embed_dims, **kwargs)
        if not 0 <= refinements <= len(self.layers):
            raise InputError(
                f"refinements use the branches of layers, each one, got {refinements} and "
                f"{len(self.layers)} layers."
            )
        self.branches = [*self.branches, *self.branches[len(self.layers) - refinements :]]
        self.num_masks, self.patches = num_masks, patches
        self.neck = EnhancedNeck(embed_dims)
        self.mask_net = mask_network(embed_dims, num_masks, nn.ReLU())
        self.activation = nn.Linear(embed_dims, embed_dims)
        self.segmentation = mask_network(embed_dims, 2, nn.LeakyReLU(0.01))
        self.mask_feature = MaskFeature(embed_dims)
        heads, dropout = layer.get("num_heads", 8), layer.get("dropout", 0.1)
        self.refinements = ModuleList(
            PatchRefinement(embed_dims, (1 + g) * embed_dims, heads, refine_ffn_dims, dropout)
            for g in range(refinements)
        )

    def forward(self, query: Tensor, *inputs: Any) -> list[Decoded]:  # type: ignore[override]
        """Run all layers, then the refinement; inputs as of `MapDecoder.forward`."""
        query_pos, reference, bev_feats, *flow = inputs
        fused, levels = self.neck(bev_feats)
        masks = self.mask_net(fused)[:, : query.shape[1] // self.num_points]
        activated = self.activation(self.instance_features(fused, masks))
        query = query + activated.repeat_interleave(self.num_points, 1)
        layers = super().forward(query, query_pos, reference, levels, *flow)
        stages = self.refined(layers[-1], fused, *flow[:2])
        return [MaskedDecoded(**vars(layer), mask_logits=masks) for layer in layers] + stages

    @staticmethod
    def instance_features(feats: Tensor, mask_logits: Tensor) -> Tensor:
        """Return means of features (B, C, H, W), weighted by masks (B, N, H, W). (B, N, C)"""
        weights = mask_logits.float().sigmoid()
        total = weights.sum((2, 3)).clamp(min=1e-6)
        return torch.einsum("bnhw,bchw->bnc", weights, feats.float()) / total[..., None]

    def refined(
        self, last: Decoded, fused: Tensor, refine: Refine, attn_mask: Tensor | None
    ) -> list[Decoded]:
        """Correct the points of the last layer in stages, each with a branch of its own."""
        segmentation = self.segmentation(fused)
        feats = self.mask_feature(fused, segmentation) if self.patches else None
        mask = mask_of_points(attn_mask, self.num_points)
        states, references = (x.flatten(1, 2) for x in (last.point_states, last.references))
        patches = fused.new_zeros(1, 1, fused.shape[1], BINS, BINS)
        outputs: list[Decoded] = []
        for branch, stage in zip(self.branches[len(self.layers) :], self.refinements, strict=True):
            references = references.detach()
            if feats is not None:
                patches = patches_around(feats, references[..., :2])
            corrected, seen = stage(states, patches, mask)
            states = torch.cat([states, seen], -1)
            references = refine(branch, corrected, references)
            output = vars(self.read(corrected, references))
            outputs.append(RefinedDecoded(**output, segmentation=segmentation))
        return outputs
