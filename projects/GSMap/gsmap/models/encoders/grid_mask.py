"""GridMask augmentation of normalised images."""

import torch
from mmdet3d.registry import MODELS
from torch import Tensor, nn

from gsmap.structures.tensors import upload
from gsmap.utils.errors import InputError


@MODELS.register_module()
class GridMask(nn.Module):
    """GridMask augmentation (arXiv 2001.04086): a regular grid of black squares in all images.

    Masked pixels are set to 0. All images of a batch get one mask. The detector calls this
    module in training only.

    Args:
        prob: Probability of masking a batch, in [0, 1].
        ratio: Width of a visible stripe as a share of the period of the grid, in (0, 1). The period
            is the distance from one square to the next; it is drawn at random for each mask.

    Raises:
        ValueError: If an argument is out of range.
    """

    def __init__(self, prob: float = 0.7, ratio: float = 0.5) -> None:
        super().__init__()
        if not 0 <= prob <= 1 or not 0 < ratio < 1:
            raise InputError(f"prob must be in [0, 1] and ratio in (0, 1), got {prob} and {ratio}.")
        self.prob = prob
        self.ratio = ratio

    def forward(self, images: Tensor) -> Tensor:
        """Mask all images of a batch with probability ``prob``. (V, 3, H, W) -> (V, 3, H, W)"""
        if torch.rand(()) >= self.prob:
            return images
        # `upload` copies a list of tensors to the device of the images without waiting for it.
        (mask,) = upload([self.draw_mask(*images.shape[-2:])], images.device)
        return images * mask.to(images.dtype)

    def draw_mask(self, height: int, width: int) -> Tensor:
        """Random mask: 0 in the squares, 1 elsewhere. (H, W)

        Args:
            height: Rows of the images, at least 3.
            width: Columns of the images.
        """
        period = int(torch.randint(2, height, ()))
        # At least one pixel of a period is visible, and at least one is masked.
        visible_px = min(max(round(period * self.ratio), 1), period - 1)
        row_shift, column_shift = torch.randint(period, (2,)).tolist()
        row_is_visible = (torch.arange(height) + row_shift) % period < visible_px
        column_is_visible = (torch.arange(width) + column_shift) % period < visible_px
        # A pixel is in a black square if neither its row nor its column is visible.
        return (row_is_visible[:, None] | column_is_visible).float()
