"""What the cameras' BEV encoders share: how they read the samples' calibration."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from mmengine.model import BaseModule
from torch import Tensor

from gsmap.structures.calibration import calibration_arrays


def stack_calibration(
    img_metas: Sequence[dict[str, Any]], names: Sequence[str], device: torch.device
) -> dict[str, Tensor]:
    """Stack what an encoder reads of the samples, see `calibration_arrays`. (B, ...) each

    Raises:
        ValueError: If a sample lacks a field.
    """
    arrays = [calibration_arrays(meta, names) for meta in img_metas]
    return {
        name: torch.as_tensor(np.stack([each[name] for each in arrays]), device=device)
        for name in names
    }


class CameraEncoder(BaseModule):
    """A BEV encoder of camera features.

    Attributes:
        calibration: What it reads of a sample, names of `calibration_arrays`.
    """

    calibration: tuple[str, ...]

    def forward(
        self, mlvl_feats: Sequence[Tensor], img_metas: Sequence[dict[str, Any]]
    ) -> dict[str, Any]:
        """Encode camera features into BEV features.

        Args:
            mlvl_feats: Image features; the first level is used. List of (B, V, C, h, w)
            img_metas: Per sample ``batch_input_shape`` and what the calibration is read from.

        Returns:
            ``bev_feats`` (B, C, H, W), row 0 at the smallest y, and what else `encode` returns.

        Raises:
            ValueError: If a sample lacks a field, or has another number of cameras.
        """
        feats = mlvl_feats[0]
        calibration = stack_calibration(img_metas, self.calibration, feats.device)
        return self.encode(feats, calibration, img_metas[0]["batch_input_shape"])

    def encode(
        self, feats: Tensor, calibration: Mapping[str, Tensor], img_shape: tuple[int, int]
    ) -> dict[str, Any]:
        """Encode features (B, V, C, h, w), with the calibration as tensors (B, ...).

        ``img_shape`` are rows and columns of the padded images.
        """
        raise NotImplementedError
