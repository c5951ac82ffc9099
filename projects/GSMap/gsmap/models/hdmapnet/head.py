"""HDMapNet's head: a segmentation of BEV features, and lines traced from its pixels."""

import random
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from mmdet3d.registry import MODELS
from mmdet3d.structures import Det3DDataSample
from mmengine.structures import InstanceData
from torch import Tensor

from gsmap.models.base.coder import DetectionHead, Samples, Tensors
from gsmap.models.base.layers import resize_map
from gsmap.models.base.parts import PartConfig
from gsmap.models.hdmapnet.decoder import LineMapDecoder, LineMaps
from gsmap.models.hdmapnet.layout import forward_size, metres_from_pixels, orient_forward
from gsmap.models.hdmapnet.losses import LineMapLosses
from gsmap.models.hdmapnet.vectorizing import VectorizeConfig, vectorize
from gsmap.structures.grid import BEVGrid
from gsmap.structures.polylines import pad_lines
from gsmap.utils.errors import InputError


@MODELS.register_module()
class HDMapNetHead(DetectionHead):
    """Head that segments BEV features, clusters the pixels into elements and traces their lines.

    Args:
        grid: Extent of the map, in metres.
        classes: Names of the classes.
        embed_dims: Channels C of the BEV features. Features with other rows and columns than the
            raster are resized.
        pixel_m: Side of a pixel in metres, as in `MakeLineMaps`.
        embedding_dims: Channels E of the instance embedding.
        num_directions: Number K of line directions, as in `MakeLineMaps`; a divisor of 360.
        decoder: Settings ``shared_direction_block`` and ``base_channels`` of `LineMapDecoder`.
        losses: Settings of `LineMapLosses`.
        vectorizing: Settings of `VectorizeConfig`.
        random_start: Whether tracing starts from a random point, as in the released code. By
            default it starts from the first point, so that predictions are reproducible.
        init_cfg: Initialisation config of mmengine.

    Raises:
        ValueError: If ``num_directions`` does not divide 360, or differs from the angle in
            ``vectorizing``.
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
        decoder: PartConfig | None = None,
        losses: PartConfig | None = None,
        vectorizing: PartConfig | None = None,
        random_start: bool = False,
        init_cfg: dict | None = None,
    ) -> None:
        super().__init__(init_cfg)
        if num_directions < 1 or 360 % num_directions:
            raise InputError(f"num_directions must divide 360, got {num_directions}.")
        self.grid = grid.rasterized(pixel_m)
        self.classes = tuple(classes)
        self.map_size = forward_size(self.grid)
        self.random_start = random_start
        self.losses = LineMapLosses(**(losses or {}))
        self.num_directions = num_directions
        degrees = 360 // num_directions  # angle between neighbouring directions
        vectorize_settings = {"degrees": degrees}
        vectorize_settings.update(vectorizing or {})
        self.vectorizing = VectorizeConfig(**vectorize_settings)
        if self.vectorizing.degrees != degrees:
            raise InputError(
                f"vectorizing.degrees is {self.vectorizing.degrees}, but {num_directions} "
                f"directions are {degrees} degrees apart: leave vectorizing.degrees out, because "
                "it follows from num_directions."
            )
        self.decoder = LineMapDecoder(
            embed_dims=embed_dims,
            num_classes=len(classes),
            embedding_dims=embedding_dims,
            num_directions=num_directions,
            **(decoder or {}),
        )

    @classmethod
    def target_settings(cls, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Return the settings of `MakeLineMaps` that follow from the head's settings."""
        return {"pixel_m": settings["pixel_m"], "num_directions": settings["num_directions"]}

    def forward(self, bev_outputs: Tensors) -> LineMaps:
        """Predict maps of all pixels from the features ``bev_feats`` (B, C, H, W).

        Rows of the predicted maps go from right to left, and columns from rear to front.
        """
        feats = orient_forward(bev_outputs["bev_feats"], self.grid)
        if feats.shape[-2:] != self.map_size:
            feats = resize_map(feats, self.map_size)
        maps = self.decoder(feats)
        return LineMaps(
            semantic=maps.semantic.float(),
            embedding=maps.embedding.float(),
            direction=maps.direction.float(),
        )

    def loss(self, bev_outputs: Tensors, batch_data_samples: Samples) -> Tensors:
        """Compute the losses of `LineMapLosses`.

        Args:
            bev_outputs: Outputs of the BEV encoder: ``bev_feats``. (B, C, H, W)
            batch_data_samples: Samples with the targets of `MakeLineMaps`.

        Raises:
            ValueError: If a sample has no targets, or targets that do not fit the head.
        """
        maps = self(bev_outputs)
        device = maps.semantic.device
        line_numbers = [self.target(sample, "gt_lines") for sample in batch_data_samples]
        directions = [self.target(sample, "gt_directions") for sample in batch_data_samples]
        with torch.autocast(device.type, enabled=False):  # losses are computed in float32
            return self.losses(
                maps,
                numbers=torch.stack(line_numbers).to(device),
                directions=torch.stack(directions).to(device),
            )

    def target(self, sample: Det3DDataSample, name: str) -> Tensor:
        """Return a target of a sample, after a check that it fits the head.

        Args:
            sample: Training sample.
            name: ``gt_lines`` (classes, rows, columns) with the number of the line at each pixel,
                or ``gt_directions`` (2, rows, columns) with the forward and the backward direction
                of that line, 1 to ``num_directions``. Both are 0 at pixels without a line.

        Returns:
            The target as integers, on the device of the sample.

        Raises:
            ValueError: If the sample has no such target, or if it does not fit the head.
        """
        if name not in sample:
            raise InputError(
                f"sample {sample.metainfo.get('token')!r} has no {name}: put MakeLineMaps into the "
                "training pipeline."
            )
        target = sample.get(name).long()
        channels = len(self.classes) if name == "gt_lines" else 2
        shape = (channels, *self.map_size)
        if tuple(target.shape) != shape:
            raise InputError(
                f"{name} is {tuple(target.shape)}, the head's maps are {shape}: give MakeLineMaps "
                "the head's pixel_m and number of classes, and the setting forward of its grid."
            )
        if name == "gt_directions" and target.max() > self.num_directions:
            raise InputError(
                f"gt_directions has direction {int(target.max())} of {self.num_directions}: give "
                "MakeLineMaps the head's num_directions."
            )
        return target

    def predict(self, bev_outputs: Tensors, batch_data_samples: Samples) -> list[InstanceData]:
        """Predict the lines of each sample, the highest score first.

        Args:
            bev_outputs: Outputs of the BEV encoder: ``bev_feats``. (B, C, H, W)
            batch_data_samples: Samples of the batch.

        Returns:
            For each sample ``pts`` (M, P, 2), the points of the lines in metres, padded with the
            last point of each line, ``num_pts`` (M,), ``labels_3d`` (M,) and ``scores_3d`` (M,).
        """
        maps = self(bev_outputs)
        results = []
        # The first axis of each of the three maps is the sample.
        for semantic, embedding, direction in zip(*maps, strict=True):
            results.append(self.lines(LineMaps(semantic, embedding, direction=direction)))
        return results

    def lines(self, maps: LineMaps) -> InstanceData:
        """Trace the lines of one sample's maps, the highest score first. (channels, H, W) each"""
        # Function from a number of points to the index of the first traced point; None for index 0.
        choose_start: Callable[[int], int] | None = None
        if self.random_start:
            choose_start = random.randrange
        # Each traced line has a label, a score, and its points as pixels (column, row).
        traced_lines = vectorize(
            maps.semantic,
            maps.embedding,
            direction=maps.direction,
            config=self.vectorizing,
            choose_start=choose_start,
        )
        lines = [line for line in traced_lines if len(line.pixels) > 1]  # one point is no line
        lines.sort(key=lambda line: -line.score)
        scores = []
        labels = []
        lengths = []
        polylines = []
        for line in lines:
            scores.append(line.score)
            labels.append(line.label)
            lengths.append(len(line.pixels))
            # The centre of pixel (column, row) is at (column + 0.5, row + 0.5).
            polylines.append(metres_from_pixels(line.pixels + 0.5, self.grid))
        instances = InstanceData(
            scores_3d=torch.tensor(scores),
            labels_3d=torch.tensor(labels, dtype=torch.long),
            pts=torch.from_numpy(pad_lines(polylines)).float(),
            num_pts=torch.tensor(lengths, dtype=torch.long),
        )
        return instances.to(maps.semantic.device)
