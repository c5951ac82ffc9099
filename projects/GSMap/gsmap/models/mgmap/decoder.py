"""MGMap's decoder: activation of queries by masks, attention to four levels, and refinement."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from mmdet3d.registry import MODELS
from mmengine.model import ModuleList
from torch import Tensor, nn

from gsmap.models.base.attention import MultiLevelAttention
from gsmap.models.base.decoder import Decoded, MapDecoder, Queries, Refine
from gsmap.models.maptr.self_attention import mask_of_points
from gsmap.models.mgmap.neck import EnhancedNeck
from gsmap.models.mgmap.refinement import (
    BINS,
    MaskFeature,
    PatchRefinement,
    crop_patches,
    mask_network,
)
from gsmap.utils.errors import InputError


@dataclass(eq=False)
class MaskedDecoded(Decoded):
    """Output of a decoder layer, with the masks that activate the queries.

    Args:
        point_states: States of the points. (B, N, P, C)
        references: Refined references, float32. (B, N, P, D)
        instance_states: States of the instances. (B, N, C)
        mask_logits: Logits of the instances' masks, shared by all layers. (B, N, H, W)
    """

    mask_logits: Tensor


@dataclass(eq=False)
class RefinedDecoded(Decoded):
    """Output of a refinement stage.

    Args:
        point_states: States of the points. (B, N, P, C)
        references: Refined references, float32. (B, N, P, D)
        instance_states: States of the instances. (B, N, C)
        segmentation: Logits of elements and of background, shared by all instances. (B, 2, H, W)
    """

    segmentation: Tensor

    def of_queries(self, queries: slice) -> Decoded:
        """Select the output of some instance queries, with the whole segmentation.

        The method of the base class would cut all fields along the queries, but the segmentation
        has no dimension of queries. So it is called for the other fields only.
        """
        all_queries = Decoded(
            self.point_states, self.references, instance_states=self.instance_states
        )
        selection = all_queries.of_queries(queries)
        return replace(self, **vars(selection))


@MODELS.register_module()
class MGMapDecoder(MapDecoder):
    """MapTR's decoder on enhanced BEV features, with activated queries and a refinement (MGMap).

    For the activation, a mask is predicted for each instance, and a projection of the mean BEV
    feature under the mask is added to the queries. The refinement corrects the points of the last
    layer in several stages.

    Args:
        layer: Settings of the layer, `MapDecoderLayer` with `MultiLevelAttention`.
        embed_dims: Channels C of the queries and of the BEV features.
        num_masks: Number of masks, one for each instance query of all query groups.
        patches: Whether the refinement uses a patch of the BEV features around each point. If
            False, all patches are zeros, as in the released model, so that the correction of a
            point does not depend on its position.
        refinements: Number of refinement stages. They use the prediction branches (the heads that
            predict classes and refine references) of the last layers again.
        refine_ffn_dims: Hidden channels of the feed-forward networks of the refinement.
        kwargs: Further arguments of `MapDecoder`.

    Raises:
        ValueError: If ``refinements`` is negative, or larger than the number of layers.
    """

    has_query_masks = True

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
        # The layers attend to all levels of the neck. Settings of the caller take precedence.
        cross_attn = {"type": MultiLevelAttention, "num_levels": EnhancedNeck.num_levels}
        cross_attn |= layer.get("cross_attn", {})
        layer = {**layer, "cross_attn": cross_attn}
        super().__init__(layer, embed_dims=embed_dims, **kwargs)
        if not 0 <= refinements <= len(self.layers):
            raise InputError(
                f"each refinement stage uses the branches of a layer, but there are {refinements} "
                f"stages and {len(self.layers)} layers: set refinements to 0 to {len(self.layers)}."
            )
        # Index of the prediction branches of each output: first the outputs of all layers, then the
        # outputs of the refinement stages, which use the branches of the last layers again.
        first_shared = len(self.layers) - refinements
        self.branches = self.branches + self.branches[first_shared:]
        self.num_masks = num_masks
        self.patches = patches
        self.neck = EnhancedNeck(embed_dims)
        self.mask_net = mask_network(embed_dims, num_masks, activation=nn.ReLU())
        # Projection of the mean features under the masks, which activate the queries.
        self.activation = nn.Linear(embed_dims, embed_dims)
        self.segmentation = mask_network(embed_dims, 2, activation=nn.LeakyReLU(0.01))
        self.mask_feature = MaskFeature(embed_dims)
        # Each stage appends C channels to the states, which the next stage reads.
        self.refinements = ModuleList()
        for number in range(refinements):
            stage = PatchRefinement(
                embed_dims,
                state_dims=(1 + number) * embed_dims,
                num_heads=layer.get("num_heads", 8),
                ffn_dims=refine_ffn_dims,
                dropout=layer.get("dropout", 0.1),
            )
            self.refinements.append(stage)

    def forward(
        self,
        query: Tensor,
        query_pos: Tensor,
        reference: Tensor,
        bev_feats: Tensor,
        refine: Refine,
        attn_mask: Tensor | None = None,
        between: Callable[[int, Queries], Queries] | None = None,
    ) -> list[Decoded]:
        """Run all layers and the refinement stages.

        Args:
            query: Content of the point queries. (B, N * P, C)
            query_pos: Learned positions of the queries. (B, N * P, C)
            reference: Initial references. (B, N * P, D)
            bev_feats: BEV features. (B, C, H, W)
            refine: Function of the index of a branch, point states (B, N * P, C) and references
                (B, N * P, D). It returns the refined references (B, N * P, D).
            attn_mask: True where an instance does not attend to another one, or None. (N, N)
            between: Function of the index of a layer and the queries after it, which returns the
                queries of the next layer. None leaves the queries unchanged.

        Returns:
            Outputs of the layers (`MaskedDecoded`), followed by the outputs of the stages
            (`RefinedDecoded`).
        """
        # Fusion of the levels (B, C, H, W), and the four levels, to which the layers attend.
        fused_feats, levels = self.neck(bev_feats)
        num_instances = query.shape[1] // self.num_points
        # The network predicts masks for the instances of all query groups. In inference, there is
        # only the first group, to which the first masks belong.
        masks = self.mask_net(fused_feats)[:, :num_instances]  # (B, N, H, W)
        instance_feats = self.instance_features(fused_feats, masks)
        mask_embeddings = self.activation(instance_feats)  # (B, N, C)
        query = query + mask_embeddings.repeat_interleave(self.num_points, dim=1)
        layers = super().forward(
            query,
            query_pos,
            reference=reference,
            bev_feats=levels,
            refine=refine,
            attn_mask=attn_mask,
            between=between,
        )
        stages = self.refine_points(layers[-1], fused_feats, refine=refine, attn_mask=attn_mask)
        outputs: list[Decoded] = []
        for layer in layers:
            outputs.append(MaskedDecoded(**vars(layer), mask_logits=masks))
        return outputs + stages

    @staticmethod
    def instance_features(feats: Tensor, mask_logits: Tensor) -> Tensor:
        """Average features with the masks of instances as weights.

        Args:
            feats: Features. (B, C, H, W)
            mask_logits: Logits of the masks. (B, N, H, W)

        Returns:
            Mean features. (B, N, C)
        """
        weights = mask_logits.float().sigmoid()
        total = weights.sum(dim=(2, 3)).clamp(min=1e-6)
        return torch.einsum("bnhw,bchw->bnc", weights, feats.float()) / total[..., None]

    def refine_points(
        self, last: Decoded, fused_feats: Tensor, refine: Refine, attn_mask: Tensor | None
    ) -> list[Decoded]:
        """Refine the points of the last layer in several stages.

        Args:
            last: Output of the last layer.
            fused_feats: BEV features of all levels of the neck. (B, C, H, W)
            refine: Function of the index of a branch, point states and references, which returns
                the refined references.
            attn_mask: True where an instance does not attend to another one, or None. (N, N)

        Returns:
            Outputs of the stages.
        """
        segmentation = self.segmentation(fused_feats)  # (B, 2, H, W)
        # Features for the patches: the BEV features, fused with the segmentation and an encoding of
        # the position. (B, C, H, W)
        feats = self.mask_feature(fused_feats, segmentation) if self.patches else None
        mask = mask_of_points(attn_mask, self.num_points)  # (N * P, N * P), or None
        states = last.point_states.flatten(1, 2)  # (B, N * P, C)
        references = last.references.flatten(1, 2)  # (B, N * P, D)
        # One patch of zeros for all points, unless patches are cropped below.
        patches = fused_feats.new_zeros(1, 1, fused_feats.shape[1], BINS, BINS)
        outputs: list[Decoded] = []
        branches = self.branches[len(self.layers) :]
        for branch, stage in zip(branches, self.refinements, strict=True):
            references = references.detach()
            if feats is not None:
                # The first two numbers of a reference are the point (x, y), in [0, 1] over the map.
                # Each point gets a patch. (B, N * P, C, 5, 5)
                patches = crop_patches(feats, references[..., :2])
            # Glimpses are the features of the patches after attention to the states. (B, N * P, C)
            # The corrected states serve only for the predictions of this stage. The next stage
            # receives the states before the correction, followed by the glimpses.
            corrected_states, glimpses = stage(states, patches, mask=mask)
            states = torch.cat([states, glimpses], dim=-1)
            references = refine(branch, corrected_states, references)
            output = self.read(corrected_states, references)  # grouped by instance
            outputs.append(RefinedDecoded(**vars(output), segmentation=segmentation))
        return outputs
