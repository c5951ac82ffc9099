"""Base class of the BEV encoders of cameras, and the batching of the cameras' calibration."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from mmengine.model import BaseModule
from torch import Tensor

from gsmap.structures.calibration import stack_calibration_arrays
from gsmap.structures.tensors import exclude_from_compile, upload


@exclude_from_compile  # it computes with float64 arrays of numpy
def stack_calibration(
    img_metas: Sequence[dict[str, Any]], names: Sequence[str], device: torch.device
) -> dict[str, Tensor]:
    """Stack the calibration of the samples of a batch.

    Args:
        img_metas: Meta information of the samples, B of them.
        names: Names of arrays of `gsmap.structures.calibration.calibration_arrays`, such as
            ``img_from_frame``.
        device: Device of the result.

    Returns:
        A tensor for each name. (B, V, 4, 4), or (B, 18) for ``can_bus``

    Raises:
        ValueError: If a sample lacks a field, or the samples differ in the number of cameras.
    """
    stacks = [torch.from_numpy(stack) for stack in stack_calibration_arrays(img_metas, names)]
    # `upload` copies all stacks at once, without waiting for a GPU.
    return dict(zip(names, upload(stacks, device), strict=True))


class CameraEncoder(BaseModule):
    """Base class of BEV encoders of camera features.

    Attributes:
        calibration: Names of the calibration arrays that the encoder reads, see
            `stack_calibration`. A subclass sets them.
        num_levels: Number of levels of image features that are used, the finest first; None for
            all levels.
    """

    calibration: tuple[str, ...]
    num_levels: int | None = 1

    def forward(
        self, mlvl_feats: Sequence[Tensor], img_metas: Sequence[dict[str, Any]]
    ) -> dict[str, Any]:
        """Encode the images of a batch.

        Args:
            mlvl_feats: Image features, one tensor per level, the finest first. (B, V, C, h, w) each
            img_metas: Meta information of the samples: ``batch_input_shape``, and the fields from
                which the calibration is read.

        Returns:
            ``bev_feats`` (B, C, H, W), row 0 at the smallest y, and further outputs of `encode`.

        Raises:
            ValueError: If a sample lacks a field, or the samples differ in the number of cameras.
        """
        calibration = stack_calibration(img_metas, self.calibration, mlvl_feats[0].device)
        feats = self.levels(mlvl_feats)
        img_shape = img_metas[0]["batch_input_shape"]  # equal for all samples of a batch
        return self.encode(feats, calibration, img_shape)

    def levels(self, mlvl_feats: Sequence[Tensor]) -> Any:
        """Select the levels that `encode` takes: one tensor for one level, otherwise a list."""
        if self.num_levels == 1:
            return mlvl_feats[0]
        return list(mlvl_feats[: self.num_levels])

    def encode(
        self, feats: Any, calibration: Mapping[str, Tensor], img_shape: tuple[int, int]
    ) -> dict[str, Any]:
        """Encode image features as BEV features.

        Args:
            feats: The selected levels. (B, V, C, h, w), or a list of such tensors
            calibration: A tensor for each name in ``self.calibration``. (B, ...)
            img_shape: Rows and columns of the padded images.

        Returns:
            ``bev_feats`` (B, C, H, W), and any further outputs by name.
        """
        raise NotImplementedError
