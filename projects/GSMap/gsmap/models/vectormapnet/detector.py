"""VectorMapNet's element detector, which predicts key points: the two corners of element boxes."""

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

from gsmap.checkpoints.class_axes import mark_classes
from gsmap.models.base.attention import BEVDeformableAttention
from gsmap.models.base.coder import DetectionHead, MapCoder, Samples, Tensors
from gsmap.models.base.layers import classification_branch, feed_forward, init_matrices
from gsmap.models.base.matching import solve_assignment
from gsmap.models.base.parts import PartConfig
from gsmap.models.base.references import Reference
from gsmap.models.vectormapnet.canvas import Canvas
from gsmap.structures.grid import BEVGrid
from gsmap.structures.tensors import constant
from gsmap.utils.errors import InputError
from gsmap.utils.settings import check_positive

_CORNERS = 2  # corners per box


class BEVEmbedding(nn.Module):
    """Linear projection of BEV features plus an embedding of each cell's row and column.

    Args:
        in_channels: Channels C' of the BEV features.
        embed_dims: Channels C of the result.
    """

    def __init__(self, in_channels: int, embed_dims: int) -> None:
        super().__init__()
        self.project = nn.Conv2d(in_channels, embed_dims, kernel_size=1)
        self.code = nn.Linear(2, embed_dims)

    def forward(self, bev_feats: Tensor) -> Tensor:
        """Embed BEV features. (B, C', H, W) -> (B, C, H, W)"""
        height, width = bev_feats.shape[-2:]
        rows = torch.linspace(-1, 1, height, device=bev_feats.device)
        columns = torch.linspace(-1, 1, width, device=bev_feats.device)
        cells = torch.stack(torch.meshgrid(rows, columns, indexing="ij"), dim=-1)  # (H, W, 2)
        return self.project(bev_feats) + self.code(cells).permute(2, 0, 1)


class KeyPointLayer(nn.Module):
    """Decoder layer: self-attention of key points, attention to the map, feed-forward network.

    The states are normalised before each of the three parts (pre-norm).

    Args:
        embed_dims: Channels C of the key points and of the map.
        num_heads: Number of attention heads.
        ffn_dims: Hidden channels of the feed-forward network.
        dropout: Probability of setting a value to zero in training, in [0, 1].
    """

    def __init__(self, embed_dims: int, num_heads: int, ffn_dims: int, dropout: float) -> None:
        super().__init__()
        self.self_attn = nn.MultiheadAttention(
            embed_dims, num_heads, dropout=dropout, batch_first=True
        )
        self.dropout = nn.Dropout(dropout)
        self.cross_attn = BEVDeformableAttention(embed_dims, num_heads, dropout=dropout)
        self.ffn = feed_forward(embed_dims, ffn_dims, dropout=dropout)
        self.norms = nn.ModuleList(nn.LayerNorm(embed_dims) for _ in range(3))

    def forward(self, states: Tensor, pos: Tensor, reference: Tensor, context: Tensor) -> Tensor:
        """Update the states of the key points.

        Args:
            states: States of the Q key points. (B, Q, C)
            pos: Positional embeddings. (B, Q, C)
            reference: Reference points in [0, 1] over the canvas. (B, Q, 2)
            context: Embedded BEV features. (B, C, H, W)

        Returns:
            Updated states. (B, Q, C)
        """
        value = self.norms[0](states)
        query = value + pos
        attention_output, _ = self.self_attn(query, query, value, need_weights=False)
        states = states + self.dropout(attention_output)
        states = states + self.cross_attn(self.norms[1](states) + pos, reference, context)
        return self.ffn(self.norms[2](states), states)  # `states` is the residual


@dataclass(frozen=True)
class KeyPointReference(Reference):
    """References of key points: box corners in pixels of the canvas.

    Args:
        canvas: Raster of the pixels.
    """

    canvas: Canvas

    def decode(self, references: Tensor) -> Tensors:
        """Convert corners from pixels (N, 2, 2) to metres, named ``pts``. (N, 2, 2)"""
        corners_norm = references / self.size(references)
        return {"pts": self.canvas.metres_from_norm(corners_norm)}

    def size(self, like: Tensor) -> Tensor:
        """Return the numbers of pixels along x and y with the device and type of a tensor. (2,)"""
        return constant(like, self.canvas.size)


class KeyPointPredictions(NamedTuple):
    """Predictions of one decoder layer of `KeyPointHead`."""

    scores: Tensor  # class logits (B, N, classes)
    references: Tensor  # corners in pixels of the canvas (B, N, 2, 2)


@MODELS.register_module()
class KeyPointHead(DetectionHead):
    """Head that detects map elements as two corners of their boxes (VectorMapNet's first stage).

    A detection is returned as a line from one corner to the other. The transform
    `FormatPolylineTargets` adds the training targets to the samples.

    Args:
        grid: Extent of the map, in metres.
        classes: Names of the classes.
        num_queries: Number N of elements.
        in_channels: Channels C' of the BEV features.
        embed_dims: Channels C of the key points.
        decoder: Settings ``num_layers``, ``num_heads``, ``ffn_dims`` and ``dropout`` of the layers.
        canvas: Settings of `Canvas`.
        cls_weight: Weight of the classification term in matching and loss.
        box_weight: Weight of the corner distances, in pixels, in matching and loss.
        giou_weight: Weight of the generalised IoU in matching.
        coder: Settings of `MapCoder`.
        init_cfg: Initialisation config of mmengine.

    Raises:
        ValueError: If ``coder`` sets ``unfold_classes``, which has no effect on boxes.
    """

    transforms = ("FormatPolylineTargets",)

    def __init__(
        self,
        grid: BEVGrid,
        classes: Sequence[str],
        num_queries: int = 120,
        in_channels: int = 128,
        embed_dims: int = 256,
        decoder: PartConfig | None = None,
        canvas: PartConfig | None = None,
        cls_weight: float = 2.0,
        box_weight: float = 0.1,
        giou_weight: float = 1.0,
        coder: PartConfig | None = None,
        init_cfg: dict | None = None,
    ) -> None:
        super().__init__(init_cfg)
        self.grid = grid
        self.classes = tuple(classes)
        self.reference: KeyPointReference = KeyPointReference(Canvas(grid, **(canvas or {})))
        # The coder selects the detections with the highest scores, by default 35. Without a margin,
        # it also keeps detections outside of the map.
        coder_settings: PartConfig = {"max_num": 35, "margin_m": None, **(coder or {})}
        self.coder = MapCoder(grid, **coder_settings)
        if self.coder.unfold_classes:
            raise InputError("coder.unfold_classes has no effect on boxes: leave it out.")
        layer_settings: PartConfig = {
            "num_heads": 8,
            "ffn_dims": 512,
            "dropout": 0.1,
            "num_layers": 6,
        }
        layer_settings |= decoder or {}
        num_layers = layer_settings.pop("num_layers")
        check_positive(num_layers=num_layers)
        self.context = BEVEmbedding(in_channels, embed_dims)
        # Embeddings have 2 C channels: the position of a query, then its content. The embedding of
        # a key point is the sum of an element's and a corner's.
        self.elements = nn.Embedding(num_queries, 2 * embed_dims)
        self.corners = nn.Embedding(_CORNERS, 2 * embed_dims)
        self.initial = nn.Linear(embed_dims, 2)  # from the position to the logits of a corner
        self.layers = nn.ModuleList(
            KeyPointLayer(embed_dims, **layer_settings) for _ in range(num_layers)
        )
        self.cls_branch = nn.Linear(_CORNERS * embed_dims, len(classes))
        mark_classes(self.cls_branch)
        # The corner branch has the layers of a classification branch, but two outputs: x and y.
        self.corner_branch = classification_branch(embed_dims, num_classes=2)
        focal_loss = {"type": "mmdet.FocalLoss", "use_sigmoid": True, "loss_weight": cls_weight}
        self.loss_cls = MODELS.build(focal_loss)
        self.cost_cls = TASK_UTILS.build({"type": "mmdet.FocalLossCost", "weight": cls_weight})
        self.box_weight = box_weight
        self.giou_weight = giou_weight

    def init_weights(self) -> None:
        """Initialise matrices with Xavier's method, and the class bias for probabilities of 1 %."""
        super().init_weights()
        for module in (self.layers, self.context, self.initial):
            init_matrices(module)
        nn.init.constant_(self.cls_branch.bias, bias_init_with_prob(0.01))

    @classmethod
    def target_settings(cls, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Return the settings of `FormatPolylineTargets` that follow from the head's settings."""
        return dict(settings["canvas"] or {})  # the transform has the settings of `Canvas`

    def forward(self, bev_outputs: Tensors) -> list[KeyPointPredictions]:
        """Predict elements from ``bev_feats`` (B, C', H, W), once per decoder layer."""
        context = self.context(bev_outputs["bev_feats"])
        embeddings = self.elements.weight[:, None] + self.corners.weight  # (N, 2, 2 C)
        embeddings = embeddings.flatten(0, 1).expand(len(context), -1, -1)  # (B, N * 2, 2 C)
        pos, states = embeddings.chunk(2, dim=-1)
        start = self.initial(pos).float()
        reference = start.sigmoid()  # all layers attend to the map around the initial corners
        outputs = []
        for layer in self.layers:
            states = layer(states, pos, reference=reference, context=context)
            outputs.append(self.predictions(states, start))
        return outputs

    def predictions(self, states: Tensor, start: Tensor) -> KeyPointPredictions:
        """Predict class scores and corners from the states of the key points.

        Args:
            states: States of the key points. (B, N * 2, C)
            start: Logits of the initial corners, to which offsets are added. (B, N * 2, 2)
        """
        element_states = states.unflatten(1, (-1, _CORNERS)).flatten(2)  # (B, N, 2 C)
        corners_norm = (self.corner_branch(states).float() + start).sigmoid()
        corners_px = corners_norm * self.reference.size(corners_norm)
        return KeyPointPredictions(
            scores=self.cls_branch(element_states).float(),
            references=corners_px.unflatten(1, (-1, _CORNERS)),
        )

    def loss(self, bev_outputs: Tensors, batch_data_samples: Samples) -> Tensors:
        """Compute ``loss_cls`` and ``loss_box``, each summed over the layers.

        Args:
            bev_outputs: Outputs of the BEV encoder: ``bev_feats``. (B, C', H, W)
            batch_data_samples: Samples with the targets of `FormatPolylineTargets`.

        Raises:
            ValueError: If a sample has no targets, or targets of another canvas.
            FloatingPointError: If a matching cost is not finite.
        """
        outputs = self(bev_outputs)
        truths = [get_targets(sample, self.reference.canvas) for sample in batch_data_samples]
        tokens = [str(sample.metainfo.get("token")) for sample in batch_data_samples]
        cls_terms = []
        box_terms = []
        # Matching and losses are computed in float32.
        with torch.autocast(bev_outputs["bev_feats"].device.type, enabled=False):
            for output in outputs:
                loss_cls, loss_box = self.layer_losses(output, truths, tokens=tokens)
                cls_terms.append(loss_cls)
                box_terms.append(loss_box)
        return {"loss_cls": torch.stack(cls_terms).sum(), "loss_box": torch.stack(box_terms).sum()}

    def layer_losses(
        self, output: KeyPointPredictions, truths: Sequence[InstanceData], tokens: Sequence[str]
    ) -> tuple[Tensor, Tensor]:
        """Compute the classification loss and the corner loss of one layer.

        Args:
            output: Predictions of the layer.
            truths: Targets of each sample: ``labels_3d`` (K,), and ``keypoints`` (K, 4), the
                corners x0, y0, x1, y1 in pixels of the canvas. (B,)
            tokens: Name (``token``) of each sample, for error messages. (B,)

        Returns:
            Both losses as weighted scalars, averaged over the matched elements of the batch. The
            corner loss is also averaged over the coordinates of an element.
        """
        scores = output.scores.float()
        boxes = output.references.float().flatten(2)  # (B, N, 4)
        # In mmdet's focal loss, the number of classes is the label of the background.
        labels = torch.full_like(scores[..., 0], len(self.classes), dtype=torch.long)
        num_matches = 0
        distances = []
        for i, truth in enumerate(truths):
            rows, cols = self.match(scores[i], boxes[i], truth=truth, token=tokens[i])
            num_matches += len(rows)
            labels[i, rows] = truth.labels_3d[cols]
            distance = F.smooth_l1_loss(
                boxes[i, rows], truth.keypoints[cols], beta=0.5, reduction="sum"
            )
            distances.append(distance)
        number = max(num_matches, 1)
        loss_cls = self.loss_cls(scores.flatten(0, 1), labels.flatten(), avg_factor=number)
        num_coordinates = 2 * _CORNERS * number  # x and y of each corner
        loss_box = self.box_weight * torch.stack(distances).sum() / num_coordinates
        return loss_cls, loss_box

    @torch.no_grad()
    def match(
        self, scores: Tensor, boxes: Tensor, truth: InstanceData, token: str
    ) -> tuple[Tensor, Tensor]:
        """Match predicted elements of one sample to annotated ones.

        Args:
            scores: Class logits. (N, classes)
            boxes: Corners x0, y0, x1, y1 in pixels of the canvas. (N, 4)
            truth: Targets of the sample, K elements.
            token: Name of the sample, for error messages.

        Returns:
            Indices of the predictions and of their annotated elements. (min(N, K),) each

        Raises:
            FloatingPointError: If a matching cost is not finite.
        """
        costs = self.costs(scores, boxes, truth=truth).cpu()  # the assignment is solved on the CPU
        names = ["class scores", "corners", "overlaps"]
        rows, cols = solve_assignment(costs, names, img_meta={"token": token})
        return rows.to(boxes.device), cols.to(boxes.device)

    def costs(self, scores: Tensor, boxes: Tensor, truth: InstanceData) -> Tensor:
        """Compute the matching costs of every prediction with every annotated element.

        Args:
            scores: Class logits. (N, classes)
            boxes: Corners x0, y0, x1, y1 in pixels of the canvas. (N, 4)
            truth: Targets of the sample, K elements.

        Returns:
            Weighted costs of classes, corner distances and overlaps. (3, N, K)
        """
        pred_instances = InstanceData(scores=scores)
        gt_instances = InstanceData(labels=truth.labels_3d)
        distance = torch.cdist(boxes, truth.keypoints, p=1)
        overlap = bbox_overlaps(boxes, truth.keypoints, mode="giou")  # a larger overlap costs less
        cls_cost = self.cost_cls(pred_instances, gt_instances)
        return torch.stack([cls_cost, self.box_weight * distance, -self.giou_weight * overlap])


def get_targets(sample: Det3DDataSample, canvas: Canvas) -> InstanceData:
    """Return the targets that `FormatPolylineTargets` has added to a sample.

    Args:
        sample: Training sample.
        canvas: Canvas of the head.

    Raises:
        ValueError: If the sample has no such targets, or if their canvas differs.
    """
    instances = sample.get("gt_instances_3d", InstanceData())
    if "keypoints" not in instances:
        raise InputError(
            f"sample {sample.metainfo.get('token')!r} has no key points: add FormatPolylineTargets "
            "to the training pipeline."
        )
    # The transform has stored the settings of its canvas: pixel, margin and ranges.
    target_settings = tuple(instances.metainfo["canvas"])
    if target_settings != canvas.settings:
        raise InputError(
            f"FormatPolylineTargets has the canvas {target_settings} (pixel_m, "
            f"margin_m, ranges), the head {canvas.settings}: give both the same pixel_m and "
            "margin_m."
        )
    return instances
