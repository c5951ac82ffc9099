"""VectorMapNet's head: a detector of elements, and a generator of their polylines."""

import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from mmdet3d.registry import MODELS
from mmengine.structures import InstanceData
from torch import Tensor

from gsmap.models.base.coder import DetectionHead, Samples, Tensors
from gsmap.models.base.parts import PARTS
from gsmap.models.vectormapnet.canvas import Canvas
from gsmap.models.vectormapnet.detector import KeyPointHead, targets_of
from gsmap.models.vectormapnet.generator import Elements, PolylineGenerator
from gsmap.structures.grid import BEVGrid
from gsmap.structures.tensors import constant


@MODELS.register_module()
class VectorMapNetHead(DetectionHead):
    """Detect elements with any head, and generate a polyline in each one's box.

    Lines take class and score of their element; one without two points is left out.

    Args:
        grid: The map's extent.
        classes: Names of the classes.
        detector: The head of the elements: `KeyPointHead` by default, or any other. Its boxes are
            those that it predicts (`KeyPointHead`), or those around its points.
        generator: Settings of `PolylineGenerator`.
        canvas: Settings of `Canvas`.
        loss_weight: Weight of the generator's loss.

    Raises:
        ValueError: If the detector is a `KeyPointHead` with another canvas.
    """

    transforms = ("FormatPolylineTargets",)
    not_exported = (
        "polylines are generated point after point, as many times as the longest one has "
        "coordinates, with random numbers: no graph of fixed steps. Export a model whose map_head "
        "is the detector alone"
    )

    def __init__(
        self,
        grid: BEVGrid,
        classes: Sequence[str],
        detector: PARTS | None = None,
        generator: PARTS | None = None,
        canvas: PARTS | None = None,
        loss_weight: float = 1.0,
        init_cfg: dict | None = None,
    ) -> None:
        super().__init__(init_cfg)
        self.grid, self.classes, self.loss_weight = grid, tuple(classes), loss_weight
        self.canvas = Canvas(grid, **(canvas or {}))
        first: PARTS = {"type": "KeyPointHead", "grid": grid, "classes": classes}
        first |= detector or {}
        if first["type"] == "KeyPointHead":
            first = {"canvas": canvas, **first}
        self.detector: DetectionHead = MODELS.build(first)
        other = self.canvas
        if isinstance(self.detector, KeyPointHead):
            other = self.detector.reference.canvas
        if other != self.canvas:
            raise ValueError(
                f"the detector's canvas {other.settings} is not the generator's "
                f"{self.canvas.settings}: give canvas to VectorMapNetHead alone."
            )
        second: PARTS = {"canvas": self.canvas, "num_classes": len(classes), **(generator or {})}
        self.generator = PolylineGenerator(**second)

    @classmethod
    def target_settings(cls, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Return the settings of the transform that follow from those of the canvas."""
        return dict(settings["canvas"] or {})

    def fit_state(self, state: dict[str, Tensor], prefix: str) -> None:
        """Fit a checkpoint's state to the detector's, in place."""
        self.detector.fit_state(state, f"{prefix}detector.")

    def forward(self, bev_outputs: Tensors) -> Sequence[object]:
        """Return the detector's predictions."""
        return self.detector(bev_outputs)

    def loss(self, bev_outputs: Tensors, batch_data_samples: Samples) -> Tensors:
        """Return the losses of both stages; annotated boxes condition the lines."""
        losses = self.detector.loss(bev_outputs, batch_data_samples)
        truths = [targets_of(sample, self.canvas) for sample in batch_data_samples]
        own = [
            self.generator.loss(
                feats,
                Elements(truth.labels_3d, truth.keypoint_tokens),
                truth.tokens,
                truth.token_weights,
            )
            for feats, truth in zip(bev_outputs["bev_feats"], truths, strict=True)
        ]
        weight = torch.cat([truth.token_weights.flatten() for truth in truths]).sum()
        seq = torch.stack(own).sum() / weight.clamp(min=1e-6)
        return losses | {"loss_seq": self.loss_weight * seq}

    def predict(self, bev_outputs: Tensors, batch_data_samples: Samples) -> list[InstanceData]:
        """Return the lines of each sample, best first: ``pts`` (M, P, 2), ``num_pts`` (M,)."""
        found = self.detector.predict(bev_outputs, batch_data_samples)
        cases = zip(bev_outputs["bev_feats"], found, batch_data_samples, strict=True)
        return [self.drawn(feats, each, sample.metainfo) for feats, each, sample in cases]

    def drawn(self, feats: Tensor, found: InstanceData, meta: Mapping[str, object]) -> InstanceData:
        """Return the lines of a sample's elements, by draws that its token alone decides."""
        seed = zlib.crc32(str(meta.get("token")).encode())
        elements = Elements(found.labels_3d, self.boxes(found))
        with torch.autocast(feats.device.type, enabled=False):
            draw = self.generator.seeded_draw(seed)
            tokens = self.generator.generate(feats.float(), elements, draw)
        points, number = self.generator.lines(tokens)
        lines = InstanceData(
            pts=points, num_pts=number, labels_3d=found.labels_3d, scores_3d=found.scores_3d
        )
        return lines[number > 1]

    def boxes(self, found: InstanceData) -> Tensor:
        """Return the boxes of elements in whole pixels of the canvas. (n, 4)"""
        corners = self.canvas.norm_from_metres(found.pts[..., :2])
        if not isinstance(self.detector, KeyPointHead):
            corners = torch.stack([corners.amin(1), corners.amax(1)], 1)
        size = constant(corners, self.canvas.size)
        pixels = (corners * size).round().clamp(min=0).minimum(size)
        return pixels.long().flatten(1)
