"""MapTR's head: hierarchical queries, per-layer predictions, matching and losses."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from mmdet.utils import reduce_mean
from mmdet3d.registry import MODELS, TASK_UTILS
from mmdet3d.structures import Det3DDataSample
from mmengine.model import BaseModule, bias_init_with_prob, xavier_init
from mmengine.structures import InstanceData
from torch import Tensor, nn

from gsmap.models.layers.deformable_attention import init_matrices
from gsmap.models.losses.direction import direction_loss
from gsmap.models.losses.point import points_l1_loss
from gsmap.models.task_modules.map_assigner import MapMatch
from gsmap.structures.grid import BEVGrid

_PRIOR_PROBABILITY = 0.01


@dataclass
class MapTargets:
    """What the predictions of one decoder layer should be.

    Attributes:
        matches: Matched pairs of every sample.
        labels: Class of every query, ``num_classes`` for background. (B * N,)
        pts: Normalised points of the matched ground truth, in the matched order, samples
            concatenated. (M, P, 2)
        avg_factor: Matched elements in the batch, averaged over ranks, at least 1. ()
    """

    matches: list[MapMatch]
    labels: Tensor
    pts: Tensor
    avg_factor: Tensor


@MODELS.register_module()
class MapHead(BaseModule):
    """Predict N map elements of P ordered points from BEV features (MapTR).

    A query is the sum of its instance's and its point's embedding; half of its channels are
    position, half content. Subclasses override :meth:`predict_offsets` (what the reference holds),
    :meth:`layer_predictions` and :meth:`prepare_gt` (what costs and losses read), and
    :meth:`matched_losses` (which losses there
    are).

    Args:
        num_classes: Number of classes.
        pc_range: x, y, z minima, then maxima, in metres.
        decoder: Config of the decoder.
        assigner: Config of the assigner.
        coder: Config of the coder that selects detections.
        loss_cls: Config of the classification loss.
        loss_weights: Weights of the further losses: ``pts``, ``dir``.
        num_instances: Number of instance queries N.
        num_points: Points per instance P.
        embed_dims: Channels C.
        num_reg_layers: Hidden layers of each branch.
        init_cfg: As in mmengine.
    """

    def __init__(
        self,
        num_classes: int,
        pc_range: Sequence[float],
        decoder: dict,
        assigner: dict,
        coder: dict,
        loss_cls: dict,
        loss_weights: dict[str, float],
        num_instances: int = 50,
        num_points: int = 20,
        embed_dims: int = 256,
        num_reg_layers: int = 2,
        init_cfg: dict | None = None,
    ) -> None:
        super().__init__(init_cfg)
        self.num_classes = num_classes
        self.num_instances = num_instances
        self.num_points = num_points
        self.embed_dims = embed_dims
        self.num_reg_layers = num_reg_layers
        self.grid = BEVGrid.from_pc_range(pc_range, 1, 1)  # only its extent is used
        self.loss_weights = dict(loss_weights)
        self.loss_cls = MODELS.build(loss_cls)
        self.assigner = TASK_UTILS.build(assigner)
        self.coder = TASK_UTILS.build(coder)
        self.decoder = MODELS.build(decoder)
        self.instance_embedding = nn.Embedding(num_instances, 2 * embed_dims)
        self.pts_embedding = nn.Embedding(num_points, 2 * embed_dims)
        self.reference_points = nn.Linear(embed_dims, 2)
        num_layers = len(self.decoder.layers)
        self.cls_branches = nn.ModuleList(self.build_cls_branch() for _ in range(num_layers))
        self.reg_branches = nn.ModuleList(self.build_reg_branch(2) for _ in range(num_layers))

    def build_cls_branch(self) -> nn.Sequential:
        """Return one layer's classifier: hidden layers with LayerNorm, then logits."""
        layers: list[nn.Module] = []
        for _ in range(self.num_reg_layers):
            layers += [
                nn.Linear(self.embed_dims, self.embed_dims),
                nn.LayerNorm(self.embed_dims),
                nn.ReLU(True),
            ]
        return nn.Sequential(*layers, nn.Linear(self.embed_dims, self.num_classes))

    def build_reg_branch(self, out_dims: int) -> nn.Sequential:
        """Return one layer's regressor of ``out_dims`` numbers per point."""
        layers: list[nn.Module] = []
        for _ in range(self.num_reg_layers):
            layers += [nn.Linear(self.embed_dims, self.embed_dims), nn.ReLU(True)]
        return nn.Sequential(*layers, nn.Linear(self.embed_dims, out_dims))

    def init_weights(self) -> None:
        """Initialise the decoder's matrices (Xavier) and let every class start improbable."""
        super().init_weights()
        init_matrices(self.decoder)
        xavier_init(self.reference_points, distribution="uniform", bias=0.0)
        for branch in self.cls_branches:
            *_, bias = branch.parameters()  # of the logits
            nn.init.constant_(bias, bias_init_with_prob(_PRIOR_PROBABILITY))

    def queries(self) -> tuple[Tensor, Tensor]:
        """Return position and content of every point query, instance by instance. 2 x (N * P, C)"""
        both = self.instance_embedding.weight[:, None] + self.pts_embedding.weight
        position, content = both.flatten(0, 1).split(self.embed_dims, -1)
        return position, content

    def initial_reference(self, query_pos: Tensor) -> Tensor:
        """Return the reference that the first layer starts from. (..., C) -> (..., D)"""
        return self.reference_points(query_pos).float().sigmoid()

    def predict_offsets(self, layer: int, states: Tensor) -> Tensor:
        """Return a layer's change of the reference, float32. (B, N * P, C) -> (B, N * P, D)"""
        return self.reg_branches[layer](states).float()

    def attention_mask(self) -> Tensor | None:
        """Return which queries may not attend to which others; MapTR has no such limit."""
        return None

    def forward(self, bev_outputs: dict[str, Tensor]) -> dict[str, Tensor]:
        """Predict the elements after every decoder layer.

        Args:
            bev_outputs: The BEV encoder's outputs; ``bev_feats`` (B, C, H, W) is read.

        Returns:
            ``all_cls_scores`` logits (L, B, N, classes), ``all_pts_preds`` normalised (L, B, N, P,
            2) and ``all_references`` (L, B, N, P, D), float32; ``states`` (L, B, N * P, C).
        """
        bev_feats = bev_outputs["bev_feats"]
        batch = len(bev_feats)
        query_pos, query = (part.expand(batch, -1, -1) for part in self.queries())
        states, references = self.decoder(
            query,
            query_pos,
            self.initial_reference(query_pos),
            bev_feats,
            self.predict_offsets,
            self.attention_mask(),
        )
        instances = states.unflatten(2, (-1, self.num_points)).mean(3)  # (L, B, N, C)
        scores = [branch(layer) for branch, layer in zip(self.cls_branches, instances, strict=True)]
        references = references.unflatten(2, (-1, self.num_points))  # (L, B, N, P, D)
        return {
            "all_cls_scores": torch.stack(scores).float(),
            "all_pts_preds": references[..., :2],
            "all_references": references,
            "states": states,
        }

    def loss(
        self, bev_outputs: dict[str, Tensor], batch_data_samples: Sequence[Det3DDataSample]
    ) -> dict[str, Tensor]:
        """Run the head and return its losses."""
        return self.loss_by_feat(
            self(bev_outputs),
            [sample.gt_instances_3d for sample in batch_data_samples],
            [sample.metainfo for sample in batch_data_samples],
        )

    def loss_by_feat(
        self,
        outputs: dict[str, Tensor],
        batch_gt_instances: Sequence[InstanceData],
        batch_img_metas: Sequence[dict[str, Any]],
    ) -> dict[str, Tensor]:
        """Prepare the ground truth and return the losses of every decoder layer.

        Args:
            outputs: What :meth:`forward` returned.
            batch_gt_instances: Per sample ``labels_3d`` (K,) and ``pts_shifts`` in metres (K, S, P,
                2).
            batch_img_metas: Meta dicts.

        Returns:
            The last layer's losses under their names, the others' with the prefix ``d<layer>.``.

        Raises:
            FloatingPointError: If a matching cost is not finite.
        """
        with torch.autocast(outputs["all_pts_preds"].device.type, enabled=False):
            gts = [self.prepare_gt(gt) for gt in batch_gt_instances]
            return self.losses_by_layer(outputs, gts, batch_img_metas)

    def losses_by_layer(
        self,
        outputs: dict[str, Tensor],
        gts: Sequence[InstanceData],
        batch_img_metas: Sequence[dict[str, Any]],
        repeats: int = 1,
    ) -> dict[str, Tensor]:
        """Return every layer's losses; each ground truth is matched to ``repeats`` queries."""
        losses = {}
        num_layers = len(outputs["all_cls_scores"])
        for layer in range(num_layers):
            predictions = self.layer_predictions(outputs, layer)
            layer_losses = self.loss_by_feat_single(predictions, gts, batch_img_metas, repeats)
            prefix = "" if layer == num_layers - 1 else f"d{layer}."
            losses.update({f"{prefix}{name}": value for name, value in layer_losses.items()})
        return losses

    def prepare_gt(self, gt_instances: InstanceData) -> InstanceData:
        """Return one sample's ``labels`` (K,) and normalised ``pts_shifts`` (K, S, P, 2)."""
        shifts = self.grid.norm_from_metres(gt_instances.pts_shifts.float())
        return InstanceData(labels=gt_instances.labels_3d, pts_shifts=shifts)

    def layer_predictions(self, outputs: dict[str, Tensor], layer: int) -> list[InstanceData]:
        """Return a layer's ``scores`` (N, classes) and normalised ``pts`` (N, P, 2), per sample."""
        scores, pts = outputs["all_cls_scores"][layer], outputs["all_pts_preds"][layer]
        return [
            InstanceData(scores=s.float(), pts=p.float()) for s, p in zip(scores, pts, strict=True)
        ]

    def loss_by_feat_single(
        self,
        predictions: Sequence[InstanceData],
        gts: Sequence[InstanceData],
        batch_img_metas: Sequence[dict[str, Any]],
        repeats: int = 1,
    ) -> dict[str, Tensor]:
        """Match one layer's predictions and return its losses."""
        targets = self.get_targets(predictions, gts, batch_img_metas, repeats)
        scores = torch.cat([prediction.scores for prediction in predictions])
        losses = {"loss_cls": self.loss_cls(scores, targets.labels, avg_factor=targets.avg_factor)}
        losses.update(self.matched_losses(predictions, gts, targets))
        return losses

    def get_targets(
        self,
        predictions: Sequence[InstanceData],
        gts: Sequence[InstanceData],
        batch_img_metas: Sequence[dict[str, Any]],
        repeats: int = 1,
    ) -> MapTargets:
        """Match every sample's predictions with its ground truth and collect the targets."""
        matches, labels, pts = [], [], []
        for prediction, gt, meta in zip(predictions, gts, batch_img_metas, strict=True):
            match = self.assigner.assign(prediction, gt, meta, repeats)
            sample_labels = gt.labels.new_full((len(prediction.scores),), self.num_classes)
            sample_labels[match.query_inds] = gt.labels[match.gt_inds]
            matches.append(match)
            labels.append(sample_labels)
            pts.append(gt.pts_shifts[match.gt_inds, match.order_inds])
        matched = torch.cat(pts)
        count = reduce_mean(matched.new_tensor(float(len(matched))))
        return MapTargets(matches, torch.cat(labels), matched, count.clamp(min=1.0))

    def matched_losses(
        self, predictions: Sequence[InstanceData], gts: Sequence[InstanceData], targets: MapTargets
    ) -> dict[str, Tensor]:
        """Return the losses of the matched predictions of one layer."""
        pred = gather_matched(predictions, targets.matches, "pts")
        pred_m, target_m = self.grid.metres_from_norm(pred), self.grid.metres_from_norm(targets.pts)
        loss_pts = points_l1_loss(pred, targets.pts, targets.avg_factor)
        loss_dir = direction_loss(pred_m, target_m, targets.avg_factor)
        return {
            "loss_pts": self.loss_weights["pts"] * loss_pts,
            "loss_dir": self.loss_weights["dir"] * loss_dir,
        }

    def predict(
        self, bev_outputs: dict[str, Tensor], batch_data_samples: Sequence[Det3DDataSample]
    ) -> list[InstanceData]:
        """Run the head and return its detections."""
        return self.predict_by_feat(
            self(bev_outputs), [sample.metainfo for sample in batch_data_samples]
        )

    def predict_by_feat(
        self, outputs: dict[str, Tensor], batch_img_metas: Sequence[dict[str, Any]]
    ) -> list[InstanceData]:
        """Decode the last layer's predictions.

        Args:
            outputs: What :meth:`forward` returned.
            batch_img_metas: Meta dicts.

        Returns:
            Per sample ``scores_3d`` (M,), ``labels_3d`` (M,) and ``pts`` (M, P, 2) in metres, best
            first.
        """
        results = []
        last = zip(outputs["all_cls_scores"][-1], outputs["all_references"][-1], strict=True)
        for scores, references in last:
            fields = self.decode_reference(references)
            best = self.coder.decode(scores, fields["pts"])
            chosen = {name: value[best.query_inds] for name, value in fields.items()}
            results.append(InstanceData(scores_3d=best.scores, labels_3d=best.labels, **chosen))
        return results

    def decode_reference(self, references: Tensor) -> dict[str, Tensor]:
        """Return what a reference (N, P, D) says in metres: ``pts`` (N, P, 2)."""
        return {"pts": self.grid.metres_from_norm(references[..., :2])}


def gather_matched(
    predictions: Sequence[InstanceData], matches: Sequence[MapMatch], field: str
) -> Tensor:
    """Return a field of the matched predictions of all samples, concatenated. (M, ...)"""
    return torch.cat([p[field][m.query_inds] for p, m in zip(predictions, matches, strict=True)])
