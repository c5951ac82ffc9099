"""MGMapNet's auxiliary head of camera masks."""

from mmdet3d.registry import MODELS
from torch import nn

from gsmap.models.base.mask_heads import PVMaskHead


@MODELS.register_module()
class NormedPVMaskHead(PVMaskHead):
    """`PVMaskHead` with a further convolution and BatchNorm (MGMapNet)."""

    @staticmethod
    def layers(embed_dims: int, num_masks: int) -> nn.Sequential:
        """Create two 3x3 convolutions with BatchNorm and a 1x1 convolution."""
        layers = nn.Sequential()
        for _ in range(2):
            conv = nn.Conv2d(embed_dims, embed_dims, kernel_size=3, padding=1, bias=False)
            layers.extend([conv, nn.BatchNorm2d(embed_dims), nn.ReLU(inplace=True)])
        return layers.append(nn.Conv2d(embed_dims, num_masks, kernel_size=1))
