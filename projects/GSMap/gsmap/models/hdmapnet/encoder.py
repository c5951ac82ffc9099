"""HDMapNet's image neck and BEV encoder: each camera's map from above, learned, on one plane."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from mmdet3d.registry import MODELS
from mmengine.model import BaseModule
from torch import Tensor, nn

from gsmap.models.base.layers import enlarged
from gsmap.models.encoders.camera_encoder import CameraEncoder
from gsmap.models.hdmapnet.layout import ahead_size
from gsmap.structures.grid import BEVGrid
from gsmap.structures.tensors import constant
from gsmap.utils.errors import InputError


def conv_block(inputs: int, outputs: int) -> list[nn.Module]:
    """Return a 3x3 convolution, its normalisation and a ReLU."""
    conv = nn.Conv2d(inputs, outputs, 3, padding=1, bias=False)
    return [conv, nn.BatchNorm2d(outputs), nn.ReLU(inplace=True)]


class JoinedMaps(nn.Sequential):
    """Enlarge a coarse map, and mix it with a fine one by two convolutions."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(*conv_block(inputs, outputs), *conv_block(outputs, outputs))

    def forward(self, fine: Tensor, coarse: Tensor) -> Tensor:  # type: ignore[override]
        """Return a map as large as the fine one. (B, C, H, W), (B, D, h, w) -> (B, E, H, W)"""
        return super().forward(torch.cat([fine, enlarged(coarse, fine.shape[-2:])], 1))


@MODELS.register_module()
class JoinLevels(BaseModule):
    """An image neck: the backbone's two levels as one map, of the finer one's size (HDMapNet).

    Args:
        in_channels: Channels of both levels, the finer first.
        out_channels: Channels of the result.
    """

    def __init__(
        self,
        in_channels: Sequence[int] = (112, 320),
        out_channels: int = 64,
        init_cfg: dict | None = None,
    ) -> None:
        super().__init__(init_cfg)
        self.joined = JoinedMaps(sum(in_channels), out_channels)

    def forward(self, feats: Sequence[Tensor]) -> tuple[Tensor]:
        """Return the map. Two (n, C, h, w) -> (n, out_channels, h, w)"""
        fine, coarse = feats
        return (self.joined(fine, coarse),)


@MODELS.register_module()
class ViewTransformEncoder(CameraEncoder):
    """Learn what each camera sees from above, and lay these maps on the ground (HDMapNet, III-B).

    A camera has a network of its own that makes a map from above of all its pixels, the same for
    each channel: 2/3 of the BEV's length and width, a sixth of that length behind the camera. Cells
    take the maximum over the cameras. Intrinsics are not read, so weights fit one set of cameras
    and one image size.

    Args:
        grid: The map's extent.
        image_size: Rows and columns of the (padded) images.
        stride: Image pixels per feature pixel.
        bev_pixel_m: Side of a BEV cell in metres; a cell of a camera's map is 5/3 of it.
        num_cams: Number of cameras.
        released_units: Whether places of cameras stay in metres, as released, where those of cells
            are counted in cells of the cameras' maps.
    """

    calibration = ("cam_from_ground",)

    def __init__(
        self,
        grid: BEVGrid,
        image_size: Sequence[int] = (128, 352),
        stride: int = 16,
        bev_pixel_m: float = 0.3,
        num_cams: int = 6,
        released_units: bool = True,
        init_cfg: dict | None = None,
    ) -> None:
        super().__init__(init_cfg)
        self.grid, self.released_units = grid.rasterized(bev_pixel_m), released_units
        self.view_pixel_m = bev_pixel_m / 0.6
        self.feature_size = image_size[0] // stride, image_size[1] // stride
        across, ahead = ahead_size(self.grid)
        self.view_size = 2 * across // 5, 2 * ahead // 5
        if min(*self.feature_size, *self.view_size) < 1:
            raise InputError(
                f"image_size {tuple(image_size)} by stride {stride} makes {self.feature_size} "
                f"feature pixels, and the map a camera's map of {self.view_size} cells: neither "
                "may be empty."
            )
        inputs = self.feature_size[0] * self.feature_size[1]
        cells = self.view_size[0] * self.view_size[1]
        self.views = nn.ModuleList(
            nn.Sequential(nn.Linear(inputs, cells), nn.ReLU(), nn.Linear(cells, cells), nn.ReLU())
            for _ in range(num_cams)
        )

    def encode(
        self, feats: Tensor, calibration: Mapping[str, Tensor], img_shape: tuple[int, int]
    ) -> dict[str, Any]:
        """Encode features (B, V, C, h, w), with ``cam_from_ground`` (B, V, 4, 4)."""
        views, places = self.from_above(feats), self.places(calibration["cam_from_ground"])
        laid_out = sampled(views.flatten(0, 1), places.flatten(0, 1)).unflatten(0, views.shape[:2])
        return {"bev_feats": laid_out.amax(1)}  # the largest of any camera; 0 where none has one

    def from_above(self, feats: Tensor) -> Tensor:
        """Return each camera's map, rows from its left, columns from near to far. (B, V, C, h, w)

        ValueError if there are other cameras or feature pixels than the encoder is built for.
        """
        found = feats.shape[1], *feats.shape[-2:]
        if found != (len(self.views), *self.feature_size):
            raise InputError(
                f"the encoder is built for {len(self.views)} cameras of {self.feature_size} "
                f"feature pixels, got {found[0]} of {found[1:]}: set num_cams, image_size and "
                "stride of ViewTransformEncoder to those of the images."
            )
        flat = feats.flatten(3).unbind(1)  # (B, C, h * w) each
        maps = [view(own) for view, own in zip(self.views, flat, strict=True)]
        return torch.stack(maps, 1).unflatten(-1, self.view_size)

    def places(self, cam_from_ground: Tensor) -> Tensor:
        """Return where the BEV cells lie in the cameras' maps: column, row. (B, V, H, W, 2)"""
        unit = self.view_pixel_m
        with torch.autocast(cam_from_ground.device.type, enabled=False):
            matrices = cam_from_ground.float()
            plane = self.plane(matrices.device)
            seen = torch.einsum("bvij,hwj->bvhwi", matrices[..., [0, 2], :2], plane)
            camera = matrices[..., [0, 2], 3] / (1.0 if self.released_units else unit)
            right, depth = (seen + camera[:, :, None, None]).unbind(-1)
        height, width = self.view_size
        return torch.stack([depth - width / 8, right + height / 2], -1)

    def plane(self, device: torch.device) -> Tensor:
        """Return the place (x, y) of each BEV cell, in cells of the cameras' maps. (H, W, 2)

        As released, the centres of the outer cells lie on the border of the map.
        """
        grid, unit = self.grid, self.view_pixel_m
        axes = (
            torch.linspace(low / unit, high / unit, number, device=device)
            for (low, high), number in ((grid.x_range, grid.width), (grid.y_range, grid.height))
        )
        return torch.stack(torch.meshgrid(*axes, indexing="xy"), -1)


def sampled(maps: Tensor, places: Tensor) -> Tensor:
    """Take values of maps between their pixels; 0 from the last row or column on, as released.

    (n, C, h, w), columns and rows (n, H, W, 2) -> (n, C, H, W)
    """
    last = constant(places, [maps.shape[-1] - 1, maps.shape[-2] - 1])
    inside = ((places >= 0) & (places < last)).all(-1)
    values = F.grid_sample(maps, 2 * places / last - 1, align_corners=True)
    return values * inside[:, None]
