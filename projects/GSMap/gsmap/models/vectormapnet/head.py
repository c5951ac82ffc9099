"""VectorMapNet's head: a detector of elements and a generator of their polylines."""

import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from mmdet3d.registry import MODELS
from mmengine.structures import InstanceData
from torch import Tensor

from gsmap.models.base.coder import DetectionHead, Samples, Tensors
from gsmap.models.base.parts import PartConfig
from gsmap.models.vectormapnet.canvas import Canvas
from gsmap.models.vectormapnet.detector import KeyPointHead, get_targets
from gsmap.models.vectormapnet.generator import Elements, PolylineGenerator
from gsmap.structures.grid import BEVGrid
from gsmap.structures.tensors import constant
from gsmap.utils.errors import InputError


@MODELS.register_module()
class VectorMapNetHead(DetectionHead):
    """Head that detects elements with another head and generates a polyline in each box.

    The detector predicts the class, the score and the box of each element. The generator writes the
    coordinates of a line as tokens: numbers of pixels of the canvas, a raster over the map. A line
    has the class and the score of its element. Lines of fewer than two points are dropped.

    Args:
        grid: Extent of the map, in metres.
        classes: Names of the classes.
        detector: Settings of the head that detects the elements, by default `KeyPointHead`. With
            any other head, the boxes are the bounding boxes of its points.
        generator: Settings of `PolylineGenerator`.
        canvas: Settings of `Canvas`.
        loss_weight: Weight of the generator's loss.
        init_cfg: Initialisation config of mmengine.

    Raises:
        ValueError: If the detector is a `KeyPointHead` with another canvas.

    Attributes:
        transforms: Transforms of the training pipeline that make the targets of the head.
        not_exported: Reason why the head has no ONNX export.
    """

    transforms = ("FormatPolylineTargets",)
    not_exported = (
        "polylines are generated coordinate by coordinate with random numbers, until the longest "
        "one ends, so the number of steps is not fixed. Export a model whose map_head is the "
        "detector alone"
    )

    def __init__(
        self,
        grid: BEVGrid,
        classes: Sequence[str],
        detector: PartConfig | None = None,
        generator: PartConfig | None = None,
        canvas: PartConfig | None = None,
        loss_weight: float = 1.0,
        init_cfg: dict | None = None,
    ) -> None:
        super().__init__(init_cfg)
        self.grid = grid
        self.classes = tuple(classes)
        self.loss_weight = loss_weight
        self.canvas = Canvas(grid, **(canvas or {}))
        detector_settings: PartConfig = {"type": "KeyPointHead", "grid": grid, "classes": classes}
        detector_settings |= detector or {}
        if detector_settings["type"] == "KeyPointHead":  # which has a canvas as well
            detector_settings = {"canvas": canvas, **detector_settings}
        self.detector: DetectionHead = MODELS.build(detector_settings)
        detector_canvas = self.canvas
        if isinstance(self.detector, KeyPointHead):
            detector_canvas = self.detector.reference.canvas
        if detector_canvas != self.canvas:
            raise InputError(
                f"the detector's canvas {detector_canvas.settings} is not the generator's "
                f"{self.canvas.settings}: give canvas to VectorMapNetHead alone."
            )
        generator_settings: PartConfig = {"canvas": self.canvas, "num_classes": len(classes)}
        generator_settings |= generator or {}
        self.generator = PolylineGenerator(**generator_settings)

    @classmethod
    def target_settings(cls, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Return the settings of `FormatPolylineTargets` that follow from the head's settings.

        Targets and head must have equal canvases, so the settings of the canvas are returned.

        Args:
            settings: Settings of the head.
        """
        return dict(settings["canvas"] or {})

    def fit_state(self, state: dict[str, Tensor], prefix: str) -> None:
        """Fit the state of a checkpoint to the detector, in place. The generator needs no change.

        Args:
            state: Tensors of the checkpoint, by name.
            prefix: Prefix of the names of this head.
        """
        self.detector.fit_state(state, f"{prefix}detector.")

    def forward(self, bev_outputs: Tensors) -> Sequence[object]:
        """Return the predictions of each layer of the detector, without generated lines."""
        return self.detector(bev_outputs)

    def loss(self, bev_outputs: Tensors, batch_data_samples: Samples) -> Tensors:
        """Compute the losses of the detector and ``loss_seq``, the loss of the generator.

        The generator is trained on annotated boxes.

        Args:
            bev_outputs: Outputs of the BEV encoder: ``bev_feats``. (B, C', H, W)
            batch_data_samples: Samples with the targets of `FormatPolylineTargets`.

        Returns:
            Losses by their names.

        Raises:
            ValueError: If a sample has no targets, or targets of another canvas (raised by
                `get_targets`).
        """
        losses = self.detector.loss(bev_outputs, batch_data_samples)
        # Classes, boxes, tokens and token weights of the annotated elements of each sample.
        truths = [get_targets(sample, self.canvas) for sample in batch_data_samples]
        sequence_losses = []
        for feats, truth in zip(bev_outputs["bev_feats"], truths, strict=True):
            elements = Elements(truth.labels_3d, truth.keypoint_tokens)
            sequence_loss = self.generator.loss(
                feats, elements, tokens=truth.tokens, weights=truth.token_weights
            )
            sequence_losses.append(sequence_loss)
        # The generator returns sums over tokens. Divided by the weights of all tokens of the batch,
        # they give the weighted mean over tokens.
        total_weight = torch.cat([truth.token_weights.flatten() for truth in truths]).sum()
        loss_seq = torch.stack(sequence_losses).sum() / total_weight.clamp(min=1e-6)
        return losses | {"loss_seq": self.loss_weight * loss_seq}

    def predict(self, bev_outputs: Tensors, batch_data_samples: Samples) -> list[InstanceData]:
        """Predict the lines of each sample, the highest score first.

        Args:
            bev_outputs: Outputs of the BEV encoder: ``bev_feats``. (B, C', H, W)
            batch_data_samples: Samples of the batch.

        Returns:
            For each sample the points ``pts`` in metres (M, P, 2), the number of points of each
            line ``num_pts`` (M,), ``labels_3d`` (M,) and ``scores_3d`` (M,). In ``pts``, the last
            point of a line is repeated to the end of the row.
        """
        detections = self.detector.predict(bev_outputs, batch_data_samples)
        results = []
        for i, sample in enumerate(batch_data_samples):
            lines = self.generate_lines(
                bev_outputs["bev_feats"][i], detections[i], meta=sample.metainfo
            )
            results.append(lines)
        return results

    def generate_lines(
        self, feats: Tensor, detections: InstanceData, meta: Mapping[str, object]
    ) -> InstanceData:
        """Generate the lines of one sample's elements, with a random seed from the sample's name.

        The random numbers of a sample thus do not depend on the samples before it.

        Args:
            feats: BEV features of the sample. (C', H, W)
            detections: Elements of the detector: ``pts``, ``labels_3d`` and ``scores_3d``.
            meta: Metadata of the sample, with its name as ``token``.

        Returns:
            Lines of two or more points, in the format of `predict`.
        """
        # Python's `hash` of a text differs between processes, a checksum does not.
        seed = zlib.crc32(str(meta.get("token")).encode())
        elements = Elements(detections.labels_3d, self.boxes(detections))
        with torch.autocast(feats.device.type, enabled=False):  # float32, even in mixed precision
            draw = self.generator.seeded_draw(seed)
            tokens = self.generator.generate(feats.float(), elements, draw=draw)
        points, num_points = self.generator.lines(tokens)
        lines = InstanceData(
            pts=points,
            num_pts=num_points,
            labels_3d=detections.labels_3d,
            scores_3d=detections.scores_3d,
        )
        return lines[num_points > 1]

    def boxes(self, detections: InstanceData) -> Tensor:
        """Return the boxes of elements, x0, y0, x1, y1 in whole pixels of the canvas. (n, 4)"""
        corners = self.canvas.norm_from_metres(detections.pts[..., :2])
        # The points of a `KeyPointHead` are already two opposite corners of a box.
        if not isinstance(self.detector, KeyPointHead):
            corners = torch.stack([corners.amin(dim=1), corners.amax(dim=1)], dim=1)
        size = constant(corners, self.canvas.size)  # a tensor on the device of `corners`
        pixels = (corners * size).round().clamp(min=0).minimum(size)
        return pixels.long().flatten(1)
