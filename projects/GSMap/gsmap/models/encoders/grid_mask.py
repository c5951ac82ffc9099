"""GridMask augmentation of normalised images."""

import torch
from mmdet3d.registry import MODELS
from torch import Tensor, nn

from gsmap.structures.tensors import uploaded


@MODELS.register_module()
class GridMask(nn.Module):
    """Black out a regular grid of squares in all images of a batch (Chen et al., 2020).

    ``prob``, in [0, 1], is the probability of a batch to be masked, ``ratio``, in (0, 1), the side
    of a kept square over the period of the grid; else ValueError.
    """

    def __init__(self, prob: float = 0.7, ratio: float = 0.5) -> None:
        super().__init__()
        if not 0 <= prob <= 1 or not 0 < ratio < 1:
            raise ValueError(f"prob must be in [0, 1] and ratio in (0, 1), got {prob} and {ratio}.")
        self.prob, self.ratio = prob, ratio

    def forward(self, images: Tensor) -> Tensor:
        """Mask the images, or return them as they are. (V, 3, H, W)"""
        if torch.rand(()) >= self.prob:
            return images
        (mask,) = uploaded([self.draw_mask(*images.shape[-2:])], images.device)
        return images * mask.to(images.dtype)

    def draw_mask(self, height: int, width: int) -> Tensor:
        """Return one where the image is kept and zero in the squares of a random grid. (H, W)"""
        period = int(torch.randint(2, height, ()))
        side = min(max(round(period * self.ratio), 1), period - 1)
        row, col = torch.randint(period, (2,)).tolist()
        in_row = (torch.arange(height) + row) % period < side
        in_col = (torch.arange(width) + col) % period < side
        return (in_row[:, None] | in_col).float()
