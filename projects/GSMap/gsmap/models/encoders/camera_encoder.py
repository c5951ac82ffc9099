"""What the cameras' BEV encoders share: how they read the samples' calibration."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from mmengine.model import BaseModule
from torch import Tensor

from gsmap.structures.calibration import calibration_arrays
from gsmap.structures.tensors import uncompiled, uploaded


@uncompiled  # numpy's float64 is not for compilers
def stack_calibration(
    img_metas: Sequence[dict[str, Any]], names: Sequence[str], device: torch.device
) -> dict[str, Tensor]:
    """Stack what an encoder reads of the samples, see `calibration_arrays`. (B, ...) each"""
    arrays = [calibration_arrays(meta, names) for meta in img_metas]
    stacks = [torch.from_numpy(np.stack([each[name] for each in arrays])) for name in names]
    return dict(zip(names, uploaded(stacks, device), strict=True))


class CameraEncoder(BaseModule):
    """A BEV encoder of camera features."""

    calibration: tuple[str, ...]  # what it reads of a sample, names of `calibration_arrays`
    num_levels: int | None = 1  # of the image features, the finest first; None takes all

    def forward(
        self, mlvl_feats: Sequence[Tensor], img_metas: Sequence[dict[str, Any]]
    ) -> dict[str, Any]:
        """Return ``bev_feats`` (B, C, H, W), row 0 at the smallest y, and what else `encode` does.

        Of the image features, a list of (B, V, C, h, w), the first levels are used. Samples have
        ``batch_input_shape`` and what the calibration is read from; ValueError if one lacks a field
        or has another number of cameras.
        """
        calibration = stack_calibration(img_metas, self.calibration, mlvl_feats[0].device)
        return self.encode(self.levels(mlvl_feats), calibration, img_metas[0]["batch_input_shape"])

    def levels(self, mlvl_feats: Sequence[Tensor]) -> Any:
        """Return what `encode` takes of all levels: the first, or a list of the first ones."""
        return mlvl_feats[0] if self.num_levels == 1 else list(mlvl_feats[: self.num_levels])

    def encode(
        self, feats: Any, calibration: Mapping[str, Tensor], img_shape: tuple[int, int]
    ) -> dict[str, Any]:
        """Encode features (B, V, C, h, w), one or a list, with the calibration as tensors (B, ...).

        ``img_shape`` are rows and columns of the padded images.
        """
        raise NotImplementedError
