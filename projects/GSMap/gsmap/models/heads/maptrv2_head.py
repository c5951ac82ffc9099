"""MapTRv2's head: what it adds to MapTR's are one-to-many queries and auxiliary segmentation."""

import logging
from collections.abc import Sequence
from typing import Any

import torch
from mmdet3d.registry import MODELS
from mmdet3d.structures import Det3DDataSample
from mmengine.logging import print_log
from mmengine.structures import InstanceData
from torch import Tensor, nn

from gsmap.models.heads.map_head import MapHead
from gsmap.models.losses.auxiliary import mask_loss


@MODELS.register_module()
class OneToManyHead(MapHead):
    """MapTR's head with further queries in training, which match each ground truth several times.

    The further queries exist in training only and share all weights but their instance embedding.
    Neither group attends to the other, so the first predicts as if alone.

    Args:
        num_instances: One-to-one instance queries, those that predict.
        num_one2many: Further instance queries; 0 switches the branch off.
        num_repeats: How often each ground truth may be matched by the further queries (k in
            MapTRv2).
        one2many_weight: Weight of their losses (lambda in MapTRv2).
        **kwargs: Arguments of the base head.

    Raises:
        ValueError: If the numbers of queries or repeats are not usable.
    """

    def __init__(
        self,
        num_instances: int = 50,
        num_one2many: int = 300,
        num_repeats: int = 6,
        one2many_weight: float = 1.0,
        **kwargs: Any,
    ) -> None:
        if num_instances < 1 or num_one2many < 0 or num_repeats < 1:
            raise ValueError(
                "need num_instances >= 1, num_one2many >= 0 and num_repeats >= 1, got "
                f"{num_instances}, {num_one2many} and {num_repeats}."
            )
        super().__init__(num_instances=num_instances + num_one2many, **kwargs)
        self.num_one2one = num_instances
        self.num_repeats = num_repeats
        self.one2many_weight = one2many_weight

    def queries(self) -> tuple[Tensor, Tensor]:
        """Return position and content of the point queries, all in training. 2 x (N * P, C)"""
        position, content = super().queries()
        if not self.training:
            position, content = (
                x[: self.num_one2one * self.num_points] for x in (position, content)
            )
        return position, content

    def attention_mask(self) -> Tensor | None:
        """Return which instances may not attend to each other: those of two groups. (N, N)"""
        if not self.training or self.num_instances == self.num_one2one:
            return None
        device = self.instance_embedding.weight.device
        further = torch.arange(self.num_instances, device=device) >= self.num_one2one
        return further[:, None] != further

    def fit_state(self, state: dict[str, Tensor], prefix: str) -> None:
        """Fit the instance queries of a checkpoint with another number of further queries.

        Those that predict are the first ones and are taken as they are. Surplus further queries are
        cut off; missing ones keep their initial values. A log line says so.

        Args:
            state: The checkpoint's state dict; changed in place.
            prefix: Prefix of the head's keys.
        """
        key = f"{prefix}instance_embedding.weight"
        own = self.instance_embedding.weight.detach()
        loaded = state.get(key)
        if loaded is None or len(loaded) < self.num_one2one or loaded.shape == own.shape:
            return
        kept = loaded[: len(own)]
        state[key] = torch.cat([kept, own[len(kept) :].to(kept)])
        print_log(
            f"{key}: the checkpoint has {len(loaded)} instance queries, the model {len(own)}; the "
            f"{self.num_one2one} that predict are taken, the further ones cut off or left as new.",
            "current",
            logging.WARNING,
        )

    def losses_by_layer(
        self,
        outputs: dict[str, Tensor],
        gts: Sequence[InstanceData],
        batch_img_metas: Sequence[dict[str, Any]],
        repeats: int = 1,
    ) -> dict[str, Tensor]:
        """Return the losses of both groups; those of the further queries end in ``_one2many``."""
        first, further = self.split_groups(outputs)
        losses = super().losses_by_layer(first, gts, batch_img_metas, repeats)
        if further["all_cls_scores"].shape[2]:
            gts = [self.further_gt(gt) for gt in gts]
            more = super().losses_by_layer(further, gts, batch_img_metas, self.num_repeats)
            losses.update(
                {f"{name}_one2many": self.one2many_weight * loss for name, loss in more.items()}
            )
        return losses

    def further_gt(self, gt: InstanceData) -> InstanceData:
        """Return what the further queries read of a sample's prepared ground truth: all of it."""
        return gt

    def split_groups(
        self, outputs: dict[str, Tensor]
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Separate the predictions ``all_*`` (L, B, N, ...) of the two groups of queries."""
        per_query = {name: value for name, value in outputs.items() if name.startswith("all_")}
        first = {name: value[:, :, : self.num_one2one] for name, value in per_query.items()}
        further = {name: value[:, :, self.num_one2one :] for name, value in per_query.items()}
        return first, further


@MODELS.register_module()
class SegmentationHead(MapHead):
    """MapTR's head with masks of the map in BEV and camera view, which only help training.

    Args:
        bev_seg: ``weight`` and ``pos_weight`` of the BEV mask's loss, or None for no such mask.
        pv_seg: The same for the camera view.
        **kwargs: Arguments of the base head.
    """

    def __init__(
        self, bev_seg: dict | None = None, pv_seg: dict | None = None, **kwargs: Any
    ) -> None:
        super().__init__(**kwargs)
        self.seg_losses = {"seg": bev_seg, "pv_seg": pv_seg}
        if bev_seg is not None:
            self.seg_head = self.build_seg_head()
        if pv_seg is not None:
            self.pv_seg_head = self.build_seg_head()

    def build_seg_head(self) -> nn.Sequential:
        """Return a 3x3 and a 1x1 convolution to one logit per cell."""
        return nn.Sequential(
            nn.Conv2d(self.embed_dims, self.embed_dims, 3, padding=1, bias=False),
            nn.ReLU(inplace=True),
            nn.Conv2d(self.embed_dims, 1, 1),
        )

    def forward(self, bev_outputs: dict[str, Tensor]) -> dict[str, Tensor]:
        """Predict elements and masks.

        Args:
            bev_outputs: The BEV encoder's ``bev_feats`` (B, C, H, W) and, for the camera view,
                ``img_feats`` (B, V, C, h, w).

        Returns:
            What the head returns, and the logits ``seg`` (B, 1, H, W) and ``pv_seg`` (B, V, 1, h,
            w).
        """
        outputs = super().forward(bev_outputs)
        if self.seg_losses["seg"] is not None:
            outputs["seg"] = self.seg_head(bev_outputs["bev_feats"])
        if self.seg_losses["pv_seg"] is not None:
            feats = bev_outputs["img_feats"]
            outputs["pv_seg"] = self.pv_seg_head(feats.flatten(0, 1)).unflatten(0, feats.shape[:2])
        return outputs

    def loss(
        self, bev_outputs: dict[str, Tensor], batch_data_samples: Sequence[Det3DDataSample]
    ) -> dict[str, Tensor]:
        """Run the head and return its losses, those of the masks included."""
        outputs = self(bev_outputs)
        losses = self.loss_by_feat(
            outputs,
            [sample.gt_instances_3d for sample in batch_data_samples],
            [sample.metainfo for sample in batch_data_samples],
        )
        losses.update(self.segmentation_losses(outputs, batch_data_samples))
        return losses

    def segmentation_losses(
        self, outputs: dict[str, Tensor], batch_data_samples: Sequence[Det3DDataSample]
    ) -> dict[str, Tensor]:
        """Return ``loss_seg`` and ``loss_pv_seg`` from the samples' ``gt_seg`` and ``gt_pv_seg``.

        Raises:
            ValueError: If a sample lacks a mask that has a loss.
        """
        losses = {}
        for name, config in self.seg_losses.items():
            if config is None:
                continue
            targets = [gt_field(sample, f"gt_{name}") for sample in batch_data_samples]
            target = torch.stack(targets).to(outputs[name].device)
            loss = mask_loss(outputs[name], target, config["pos_weight"])
            losses[f"loss_{name}"] = config["weight"] * loss
        return losses

    def predict(
        self, bev_outputs: dict[str, Tensor], batch_data_samples: Sequence[Det3DDataSample]
    ) -> list[InstanceData]:
        """Run the head without its masks and return its detections."""
        metas = [sample.metainfo for sample in batch_data_samples]
        return self.predict_by_feat(super().forward(bev_outputs), metas)


@MODELS.register_module()
class MapTRv2Head(SegmentationHead, OneToManyHead):
    """MapTR's head with one-to-many queries and auxiliary segmentation (MapTRv2)."""


def gt_field(sample: Det3DDataSample, name: str) -> Tensor:
    """Return a training target of a sample.

    Raises:
        ValueError: If the sample does not have it.
    """
    if name not in sample:
        raise ValueError(
            f"sample {sample.metainfo.get('token')!r} has no {name}: add its transform to the "
            "training pipeline, or remove its loss from the model."
        )
    return torch.as_tensor(getattr(sample, name))
