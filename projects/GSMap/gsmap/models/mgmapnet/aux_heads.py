"""MGMapNet's auxiliary head."""

from mmdet3d.registry import MODELS
from torch import nn

from gsmap.models.base.mask_heads import PVMaskHead


@MODELS.register_module()
class NormedPVMaskHead(PVMaskHead):
    """`PVMaskHead` with one more convolution, and BatchNorm (MGMapNet)."""

    @staticmethod
    def layers(embed_dims: int, num_masks: int) -> nn.Sequential:
        """Return two 3x3 convolutions with BatchNorm and a 1x1."""
        layers: list[nn.Module] = []
        for _ in range(2):
            conv = nn.Conv2d(embed_dims, embed_dims, 3, padding=1, bias=False)
            layers += [conv, nn.BatchNorm2d(embed_dims), nn.ReLU(True)]
        return nn.Sequential(*layers, nn.Conv2d(embed_dims, num_masks, 1))
