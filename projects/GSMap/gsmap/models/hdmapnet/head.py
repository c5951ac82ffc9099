"""HDMapNet's head: a segmentation of any BEV features, and lines of its pixels."""

import random
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from mmdet3d.registry import MODELS
from mmdet3d.structures import Det3DDataSample
from mmengine.structures import InstanceData
from torch import Tensor

from gsmap.models.base.coder import DetectionHead, Samples, Tensors
from gsmap.models.base.layers import enlarged
from gsmap.models.base.parts import PARTS
from gsmap.models.hdmapnet.decoder import LineMapDecoder, LineMaps
from gsmap.models.hdmapnet.layout import ahead_size, metres_from_pixels, turned
from gsmap.models.hdmapnet.losses import LineMapLosses
from gsmap.models.hdmapnet.vectorizing import VectorizeConfig, vectorize
from gsmap.structures.grid import BEVGrid
from gsmap.structures.polylines import padded
from gsmap.utils.errors import InputError

TARGETS = ("gt_lines", "gt_directions")


@MODELS.register_module()
class HDMapNetHead(DetectionHead):
    """Segment BEV features into lines, tell their elements apart, and trace them (HDMapNet).

    Args:
        grid: The map's extent.
        classes: Names of the classes.
        embed_dims: Channels of the BEV features, from any encoder; they are resized to the pixels.
        pixel_m: Side of a pixel in metres, as in `MakeLineMaps`.
        embedding_dims: Channels of the embedding that tells elements apart.
        num_directions: Directions that a line may have, as in `MakeLineMaps`.
        decoder: Settings of `LineMapDecoder`: ``shared_direction_block``, ``base_channels``.
        losses: Settings of `LineMapLosses`.
        vectorizing: Settings of `VectorizeConfig`.
        random_start: Whether tracing begins at a point taken by chance, as released; by default at
            the first, so that the same features give the same lines.

    Raises:
        ValueError: If directions are no whole numbers of degrees apart.
    """

    transforms = ("MakeLineMaps",)
    not_exported = (
        "its lines are clustered and traced pixel by pixel, which ONNX has no operator for"
    )

    def __init__(
        self,
        grid: BEVGrid,
        classes: Sequence[str],
        embed_dims: int = 256,
        pixel_m: float = 0.15,
        embedding_dims: int = 16,
        num_directions: int = 36,
        decoder: PARTS | None = None,
        losses: PARTS | None = None,
        vectorizing: PARTS | None = None,
        random_start: bool = False,
        init_cfg: dict | None = None,
    ) -> None:
        super().__init__(init_cfg)
        if num_directions < 1 or 360 % num_directions:
            raise InputError(f"num_directions must divide 360, got {num_directions}.")
        self.grid, self.classes = grid.rasterized(pixel_m), tuple(classes)
        self.map_size, self.random_start = ahead_size(self.grid), random_start
        self.losses = LineMapLosses(**(losses or {}))
        self.num_directions, degrees = num_directions, 360 // num_directions
        self.vectorizing = VectorizeConfig(**{"degrees": degrees, **(vectorizing or {})})
        if self.vectorizing.degrees != degrees:
            raise InputError(
                f"vectorizing.degrees is {self.vectorizing.degrees}, but {num_directions} "
                f"directions are {degrees} degrees apart: leave it out, num_directions decides it."
            )
        sizes = embed_dims, len(classes), embedding_dims, num_directions
        self.decoder = LineMapDecoder(*sizes, **(decoder or {}))

    @classmethod
    def target_settings(cls, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Return the settings of the transform that follow from those of the head."""
        return {name: settings[name] for name in ("pixel_m", "num_directions")}

    def forward(self, bev_outputs: Tensors) -> LineMaps:
        """Return maps of all pixels, from ``bev_feats`` (B, C, H, W)."""
        feats = turned(bev_outputs["bev_feats"], self.grid)
        if feats.shape[-2:] != self.map_size:
            feats = enlarged(feats, self.map_size)
        return LineMaps(*(values.float() for values in self.decoder(feats)))

    def loss(self, bev_outputs: Tensors, batch_data_samples: Samples) -> Tensors:
        """Run the head and return its losses."""
        maps = self(bev_outputs)
        numbers, directions = (
            torch.stack([self.target(sample, name) for sample in batch_data_samples])
            for name in TARGETS
        )
        with torch.autocast(maps.semantic.device.type, enabled=False):
            return self.losses(maps, *(t.to(maps.semantic.device) for t in (numbers, directions)))

    def target(self, sample: Det3DDataSample, name: str) -> Tensor:
        """Return a sample's target; ValueError if there is none, or it is not of this head."""
        if name not in sample:
            raise InputError(
                f"sample {sample.metainfo.get('token')!r} has no {name}: put MakeLineMaps into the "
                "training pipeline."
            )
        target = sample.get(name).long()
        wanted = {"gt_lines": len(self.classes), "gt_directions": 2}[name], *self.map_size
        if tuple(target.shape) != wanted:
            raise InputError(
                f"{name} is {tuple(target.shape)}, the head's maps are {wanted}: give MakeLineMaps "
                "the head's pixel_m and number of classes, and the grid's forward."
            )
        if name == "gt_directions" and target.max() > self.num_directions:
            raise InputError(
                f"gt_directions has direction {int(target.max())} of {self.num_directions}: give "
                "MakeLineMaps the head's num_directions."
            )
        return target

    def predict(self, bev_outputs: Tensors, batch_data_samples: Samples) -> list[InstanceData]:
        """Run the head and return its lines, as `DetectionHead` its detections.

        ``pts`` (M, P, 2) has the last point of each line repeated, ``num_pts`` (M,) their numbers.
        """
        return [self.lines(LineMaps(*own)) for own in zip(*self(bev_outputs), strict=True)]

    def lines(self, maps: LineMaps) -> InstanceData:
        """Return the lines of a sample's maps, (channels, H, W) each, best first."""
        choose_start: Any = random.randrange if self.random_start else None
        found = vectorize(*maps, self.vectorizing, choose_start)
        found = [line for line in found if len(line.pixels) > 1]
        found.sort(key=lambda line: -line.score)
        pts = padded([metres_from_pixels(line.pixels + 0.5, self.grid) for line in found])
        lines = InstanceData(
            scores_3d=torch.tensor([line.score for line in found]),
            labels_3d=torch.tensor([line.label for line in found], dtype=torch.long),
            pts=torch.from_numpy(pts).float(),
            num_pts=torch.tensor([len(line.pixels) for line in found], dtype=torch.long),
        )
        return lines.to(maps.semantic.device)
