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
    """Stack what an encoder reads of the samples, see `calibration_arrays`. (B, ...) each"""
    arrays = [calibration_arrays(meta, names) for meta in img_metas]
    stacks = {name: np.stack([each[name] for each in arrays]) for name in names}
    return {name: torch.as_tensor(stack, device=device) for name, stack in stacks.items()}


class CameraEncoder(BaseModule):
    """A BEV encoder of camera features."""

    calibration: tuple[str, ...]  # what it reads of a sample, names of `calibration_arrays`

    def forward(
        self, mlvl_feats: Sequence[Tensor], img_metas: Sequence[dict[str, Any]]
    ) -> dict[str, Any]:
        """Return ``bev_feats`` (B, C, H, W), row 0 at the smallest y, and what else `encode` does.

        Image features are a list of (B, V, C, h, w). Samples have ``batch_input_shape`` and what
        the calibration is read from; ValueError if one lacks a field or has another number of
        cameras.
        """
        calibration = stack_calibration(img_metas, self.calibration, mlvl_feats[0].device)
        feats = self.levels_of(mlvl_feats)
        return self.encode(feats, calibration, img_metas[0]["batch_input_shape"])

    def levels_of(self, mlvl_feats: Sequence[Tensor]) -> Any:
        """Return the image features that `encode` takes: the first level."""
        return mlvl_feats[0]

    def encode(
        self, feats: Any, calibration: Mapping[str, Tensor], img_shape: tuple[int, int]
    ) -> dict[str, Any]:
        """Encode what `levels_of` returns, with the calibration as tensors (B, ...).

        ``img_shape`` are rows and columns of the padded images.
        """
        raise NotImplementedError
