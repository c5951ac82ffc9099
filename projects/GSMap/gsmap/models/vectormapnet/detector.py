"""VectorMapNet's element detector: elements as key points, the corners of their boxes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from mmdet.structures.bbox import bbox_overlaps
from mmdet3d.registry import MODELS, TASK_UTILS
from mmdet3d.structures import Det3DDataSample
from mmengine.model import bias_init_with_prob
from mmengine.structures import InstanceData
from torch import Tensor, nn

from gsmap.models.base.attention import BEVDeformableAttention
from gsmap.models.base.coder import DetectionHead, MapCoder, Samples, Tensors
from gsmap.models.base.layers import classification_branch, feed_forward, init_matrices
from gsmap.models.base.matching import assigned
from gsmap.models.base.parts import PARTS
from gsmap.models.base.references import Reference
from gsmap.models.vectormapnet.canvas import Canvas
from gsmap.structures.grid import BEVGrid
from gsmap.structures.tensors import constant

_CORNERS = 2


class CodedMap(nn.Module):
    """BEV features in other channels, plus a code of their row and column."""

    def __init__(self, in_channels: int, embed_dims: int) -> None:
        super().__init__()
        self.project = nn.Conv2d(in_channels, embed_dims, 1)
        self.code = nn.Linear(2, embed_dims)

    def forward(self, bev_feats: Tensor) -> Tensor:
        """Return the coded map. (B, C', H, W) -> (B, C, H, W)"""
        axes = (torch.linspace(-1, 1, n, device=bev_feats.device) for n in bev_feats.shape[-2:])
        places = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)
        return self.project(bev_feats) + self.code(places).permute(2, 0, 1)


class KeyPointLayer(nn.Module):
    """Self-attention of all key points, attention to the map, feed-forward network; pre-norm."""

    def __init__(self, embed_dims: int, num_heads: int, ffn_dims: int, dropout: float) -> None:
        super().__init__()
        self.self_attn = nn.MultiheadAttention(embed_dims, num_heads, dropout, batch_first=True)
        self.dropout = nn.Dropout(dropout)
        self.cross_attn = BEVDeformableAttention(embed_dims, num_heads, dropout=dropout)
        self.ffn = feed_forward(embed_dims, ffn_dims, dropout)
        self.norms = nn.ModuleList(nn.LayerNorm(embed_dims) for _ in range(3))

    def forward(self, states: Tensor, pos: Tensor, reference: Tensor, context: Tensor) -> Tensor:
        """Update the key points. (B, Q, C)"""
        value = self.norms[0](states)
        query = value + pos
        shared, _ = self.self_attn(query, query, value, need_weights=False)
        states = states + self.dropout(shared)
        states = states + self.cross_attn(self.norms[1](states) + pos, reference, context)
        return self.ffn(self.norms[2](states), states)


@dataclass(frozen=True)
class KeyPointReference(Reference):
    """What key points are: corners of boxes on the canvas, in pixels."""

    canvas: Canvas

    def decode(self, references: Tensor) -> Tensors:
        """Return ``pts``, both corners in metres. (N, 2, 2)"""
        return {"pts": self.canvas.metres_from_norm(references / self.size(references))}

    def size(self, like: Tensor) -> Tensor:
        """Return the numbers of pixels. (2,)"""
        return constant(like, self.canvas.size)


class KeyPointPredictions(NamedTuple):
    """What the detector says after a layer."""

    scores: Tensor  # class logits (B, N, classes)
    references: Tensor  # corners in pixels of the canvas (B, N, 2, 2)


@MODELS.register_module()
class KeyPointHead(DetectionHead):
    """Detect map elements as two corners of their boxes (VectorMapNet's first stage).

    Its detections are lines from one corner to the other. The targets are those of
    `FormatPolylineTargets`.

    Args:
        grid: The map's extent.
        classes: Names of the classes.
        num_queries: Number of elements N.
        in_channels: Channels of the BEV features.
        embed_dims: Channels C of the key points.
        decoder: ``num_layers``, ``num_heads``, ``ffn_dims``, ``dropout``.
        canvas: Settings of `Canvas`.
        cls_weight: Weight of the classes, in matching and losses.
        box_weight: Weight of the corners, whose distances are in pixels.
        giou_weight: Weight of the generalised IoU in matching.
        coder: Settings of `MapCoder`.
    """

    transforms = ("FormatPolylineTargets",)

    def __init__(
        self,
        grid: BEVGrid,
        classes: Sequence[str],
        num_queries: int = 120,
        in_channels: int = 128,
        embed_dims: int = 256,
        decoder: PARTS | None = None,
        canvas: PARTS | None = None,
        cls_weight: float = 2.0,
        box_weight: float = 0.1,
        giou_weight: float = 1.0,
        coder: PARTS | None = None,
        init_cfg: dict | None = None,
    ) -> None:
        super().__init__(init_cfg)
        self.grid, self.classes = grid, tuple(classes)
        self.reference: KeyPointReference = KeyPointReference(Canvas(grid, **(canvas or {})))
        choice: PARTS = {"max_num": 35, "margin_m": None, **(coder or {})}
        self.coder = MapCoder(grid, **choice)
        if self.coder.unfold_classes:
            raise ValueError("coder.unfold_classes has no effect on boxes: leave it out.")
        settings: PARTS = {"num_layers": 6, "num_heads": 8, "ffn_dims": 512, "dropout": 0.1}
        settings |= decoder or {}
        num_layers = settings.pop("num_layers")
        self.context = CodedMap(in_channels, embed_dims)
        self.elements = nn.Embedding(num_queries, 2 * embed_dims)
        self.corners = nn.Embedding(_CORNERS, 2 * embed_dims)
        self.initial = nn.Linear(embed_dims, 2)
        self.layers = nn.ModuleList(
            KeyPointLayer(embed_dims, **settings) for _ in range(num_layers)
        )
        self.cls_branch = nn.Linear(_CORNERS * embed_dims, len(classes))
        self.corner_branch = classification_branch(embed_dims, 2)
        focal = {"type": "mmdet.FocalLoss", "use_sigmoid": True, "loss_weight": cls_weight}
        self.loss_cls = MODELS.build(focal)
        self.cost_cls = TASK_UTILS.build({"type": "mmdet.FocalLossCost", "weight": cls_weight})
        self.box_weight, self.giou_weight = box_weight, giou_weight

    def init_weights(self) -> None:
        """Initialise the layers' matrices (Xavier), and let every class be unlikely."""
        super().init_weights()
        for part in (self.layers, self.context, self.initial):
            init_matrices(part)
        nn.init.constant_(self.cls_branch.bias, bias_init_with_prob(0.01))

    @classmethod
    def target_settings(cls, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Return the settings of the transform that follow from those of the canvas."""
        return dict(settings["canvas"] or {})

    def forward(self, bev_outputs: Tensors) -> list[KeyPointPredictions]:
        """Predict the elements after every layer, from ``bev_feats`` (B, C', H, W)."""
        context = self.context(bev_outputs["bev_feats"])
        queries = self.elements.weight[:, None] + self.corners.weight  # (N, 2, 2 C)
        queries = queries.flatten(0, 1).expand(len(context), -1, -1)
        pos, states = queries.chunk(2, -1)
        start = self.initial(pos).float()
        reference, outputs = start.sigmoid(), []
        for layer in self.layers:
            states = layer(states, pos, reference, context)
            outputs.append(self.predictions(states, start))
        return outputs

    def predictions(self, states: Tensor, start: Tensor) -> KeyPointPredictions:
        """Return the scores and corners of key points (B, N * 2, C) that start somewhere."""
        by_element = states.unflatten(1, (-1, _CORNERS))
        corners = (self.corner_branch(states).float() + start).sigmoid()
        corners = (corners * self.reference.size(corners)).unflatten(1, (-1, _CORNERS))
        return KeyPointPredictions(self.cls_branch(by_element.flatten(2)).float(), corners)

    def loss(self, bev_outputs: Tensors, batch_data_samples: Samples) -> Tensors:
        """Run the head and return its losses, sums of all layers."""
        outputs = self(bev_outputs)
        truths = [targets_of(sample, self.reference.canvas) for sample in batch_data_samples]
        tokens = [str(sample.metainfo.get("token")) for sample in batch_data_samples]
        with torch.autocast(bev_outputs["bev_feats"].device.type, enabled=False):
            layers = [self.layer_losses(output, truths, tokens) for output in outputs]
        cls, box = (torch.stack(terms).sum() for terms in zip(*layers, strict=True))
        return {"loss_cls": cls, "loss_box": box}

    def layer_losses(
        self, output: KeyPointPredictions, truths: Sequence[InstanceData], tokens: Sequence[str]
    ) -> tuple[Tensor, Tensor]:
        """Return the losses of classes and of corners of a layer."""
        scores, boxes = output.scores.float(), output.references.float().flatten(2)
        pairs = [self.match(*case) for case in zip(scores, boxes, truths, tokens, strict=True)]
        labels = torch.full_like(scores[..., 0], len(self.classes), dtype=torch.long)
        off = []
        for i, ((rows, cols), truth) in enumerate(zip(pairs, truths, strict=True)):
            labels[i, rows] = truth.labels_3d[cols]
            off.append(
                F.smooth_l1_loss(boxes[i, rows], truth.keypoints[cols], beta=0.5, reduction="sum")
            )
        number = max(sum(len(rows) for rows, _ in pairs), 1)
        cls = self.loss_cls(scores.flatten(0, 1), labels.flatten(), avg_factor=number)
        return cls, self.box_weight * torch.stack(off).sum() / (2 * _CORNERS * number)

    @torch.no_grad()
    def match(
        self, scores: Tensor, boxes: Tensor, truth: InstanceData, token: str
    ) -> tuple[Tensor, Tensor]:
        """Match a sample's boxes in pixels; FloatingPointError if a cost is not finite."""
        costs = self.costs(scores, boxes, truth).cpu()
        rows, cols = assigned(costs, ["class scores", "corners", "overlaps"], {"token": token})
        return rows.to(boxes.device), cols.to(boxes.device)

    def costs(self, scores: Tensor, boxes: Tensor, truth: InstanceData) -> Tensor:
        """Return the costs of classes, corners and overlaps. (3, N, K)"""
        predicted, annotated = InstanceData(scores=scores), InstanceData(labels=truth.labels_3d)
        apart = torch.cdist(boxes, truth.keypoints, p=1)
        overlap = bbox_overlaps(boxes, truth.keypoints, mode="giou")
        cls = self.cost_cls(predicted, annotated)
        return torch.stack([cls, self.box_weight * apart, -self.giou_weight * overlap])


def targets_of(sample: Det3DDataSample, canvas: Canvas) -> InstanceData:
    """Return a sample's targets; ValueError if they are of another kind or of another canvas."""
    instances = sample.get("gt_instances_3d", InstanceData())
    if "keypoints" not in instances:
        raise ValueError(
            f"sample {sample.metainfo.get('token')!r} has no key points: add FormatPolylineTargets "
            "to the training pipeline."
        )
    if tuple(instances.metainfo["canvas"]) != canvas.settings:
        raise ValueError(
            f"FormatPolylineTargets has the canvas {tuple(instances.metainfo['canvas'])} (pixel_m, "
            f"margin_m, ranges), the head {canvas.settings}: give both the same pixel_m and "
            "margin_m."
        )
    return instances
