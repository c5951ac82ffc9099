"""HDMapNet's image neck and BEV encoder, which learns a view transformation for each camera."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from mmdet3d.registry import MODELS
from mmengine.model import BaseModule
from torch import Tensor, nn

from gsmap.models.base.layers import resize_map
from gsmap.models.encoders.camera_encoder import CameraEncoder
from gsmap.models.hdmapnet.layout import forward_size
from gsmap.structures.grid import BEVGrid
from gsmap.structures.tensors import constant
from gsmap.utils.errors import InputError


def conv_block(inputs: int, outputs: int) -> list[nn.Module]:
    """Return a 3x3 convolution without bias, its batch normalisation and a ReLU."""
    conv = nn.Conv2d(inputs, outputs, kernel_size=3, padding=1, bias=False)
    return [conv, nn.BatchNorm2d(outputs), nn.ReLU(inplace=True)]


class JoinedMaps(nn.Sequential):
    """Fusion of a fine and a resized coarse map by two convolutions.

    Args:
        inputs: C + D, the channels of the fine map plus the channels of the coarse one.
        outputs: Channels E of the result.
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        blocks = conv_block(inputs, outputs) + conv_block(outputs, outputs)
        super().__init__(*blocks)

    def forward(self, fine: Tensor, coarse: Tensor) -> Tensor:  # type: ignore[override]
        """Fuse two maps. (B, C, H, W), (B, D, h, w) -> (B, E, H, W)"""
        coarse = resize_map(coarse, fine.shape[-2:])
        return super().forward(torch.cat([fine, coarse], dim=1))


@MODELS.register_module()
class JoinLevels(BaseModule):
    """Image neck that fuses two levels of the backbone at the size of the finer one (HDMapNet).

    Args:
        in_channels: Channels of both levels, the finer one first.
        out_channels: Channels of the result.
        init_cfg: Initialisation config of mmengine.
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
        """Fuse both levels. The tuple has one level, because an image neck returns a sequence.

        Two levels (n, C, h, w) of different sizes -> one level (n, out_channels, h, w) of the finer
        size.
        """
        fine, coarse = feats
        return (self.joined(fine, coarse),)


@MODELS.register_module()
class ViewTransformEncoder(CameraEncoder):
    """BEV encoder with a learned view transformation for each camera (HDMapNet, III-B).

    For each camera, a fully connected network transforms the pixels of a feature channel to a
    camera map, a map of the ground ahead of the camera from above. All channels share the weights.
    The camera map has 2/3 of the length and width of the BEV. It begins ahead of the camera, at a
    distance of an eighth of the length of the camera map. A BEV cell takes the maximum over all
    camera maps. Intrinsics are not used, so the weights fit one set of cameras and one image size.

    Args:
        grid: Extent of the map, in metres.
        image_size: Rows and columns of the (padded) images.
        stride: Image pixels per feature pixel.
        bev_pixel_m: Side of a BEV cell in metres; a cell of a camera map is 5/3 as long.
        num_cams: Number V of cameras.
        released_units: Whether camera positions are in metres while cell positions are in cells of
            the camera maps, as in the released code. Otherwise both are in cells.
        init_cfg: Initialisation config of mmengine.

    Raises:
        ValueError: If the features or the camera maps would be empty.
    """

    calibration = ("cam_from_ground",)  # the array that `encode` receives

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
        self.grid = grid.rasterized(bev_pixel_m)  # the extent of `grid` in cells of this side
        self.released_units = released_units
        self.view_pixel_m = bev_pixel_m / 0.6  # side of a cell of a camera map: 5/3 of a BEV cell
        self.feature_size = (image_size[0] // stride, image_size[1] // stride)
        num_rows, num_columns = forward_size(self.grid)  # rows across the direction of travel
        # 2/3 of the size of the BEV, in cells that are 5/3 as long: 2/3 divided by 5/3 is 2/5.
        self.view_size = (2 * num_rows // 5, 2 * num_columns // 5)
        if min(self.feature_size + self.view_size) < 1:
            raise InputError(
                f"image_size {tuple(image_size)} and stride {stride} give {self.feature_size} "
                f"feature pixels, and the size of the map gives camera maps of {self.view_size} "
                "cells: neither may be empty."
            )
        num_inputs = self.feature_size[0] * self.feature_size[1]
        num_cells = self.view_size[0] * self.view_size[1]
        self.views = nn.ModuleList()  # the network of each camera
        for _ in range(num_cams):
            network = nn.Sequential(
                nn.Linear(num_inputs, num_cells),
                nn.ReLU(),
                nn.Linear(num_cells, num_cells),
                nn.ReLU(),
            )
            self.views.append(network)

    def encode(
        self, feats: Tensor, calibration: Mapping[str, Tensor], img_shape: tuple[int, int]
    ) -> dict[str, Any]:
        """Encode image features to BEV features.

        Args:
            feats: Image features. (B, V, C, h, w)
            calibration: ``cam_from_ground``, transforms from the ground frame to the camera frames,
                in metres. (B, V, 4, 4)
            img_shape: Rows and columns of the padded images; unused.

        Returns:
            ``bev_feats``, 0 where no camera map covers a cell (B, C, H, W), and the input as
            ``img_feats``.
        """
        camera_maps = self.transform_views(feats)  # (B, V, C, rows, columns)
        positions = self.cell_positions(calibration["cam_from_ground"])  # (B, V, H, W, 2)
        samples = sample_maps(camera_maps.flatten(0, 1), positions.flatten(0, 1))
        samples = samples.unflatten(0, camera_maps.shape[:2])  # (B, V, C, H, W)
        # Camera maps are >= 0, because they come from a ReLU. So the 0 of a camera that does not
        # cover a cell never exceeds the value of another camera.
        return {"bev_feats": samples.amax(dim=1), "img_feats": feats}

    def transform_views(self, feats: Tensor) -> Tensor:
        """Transform the features of each camera to its top-down camera map.

        Args:
            feats: Image features. (B, V, C, h, w)

        Returns:
            Camera maps: rows from the camera's left to its right, columns from near to far.
            (B, V, C, rows, columns)

        Raises:
            ValueError: If the number of cameras or the size of the features differs from the
                settings.
        """
        num_cams = feats.shape[1]
        size = tuple(feats.shape[-2:])
        if num_cams != len(self.views) or size != self.feature_size:
            raise InputError(
                f"the encoder is built for {len(self.views)} cameras of {self.feature_size} "
                f"feature pixels, got {num_cams} of {size}: set num_cams, image_size and "
                "stride of ViewTransformEncoder to the values of the images."
            )
        pixels = feats.flatten(3).unbind(dim=1)  # (B, C, h * w) for each camera
        maps = [network(inputs) for network, inputs in zip(self.views, pixels, strict=True)]
        return torch.stack(maps, dim=1).unflatten(-1, self.view_size)

    def cell_positions(self, cam_from_ground: Tensor) -> Tensor:
        """Compute the positions of the BEV cells in the camera maps.

        Args:
            cam_from_ground: Transforms from the ground frame to the camera frames, in metres.
                (B, V, 4, 4)

        Returns:
            Continuous column and row of each cell. (B, V, H, W, 2)
        """
        # Half precision would be too coarse for positions.
        with torch.autocast(cam_from_ground.device.type, enabled=False):
            matrices = cam_from_ground.float()
            cells = self.cell_coordinates(matrices.device)
            # The rows for x (right) and z (ahead) of the camera frame. The third column is not
            # needed, because the points lie on the ground, where z = 0.
            rotations = matrices[..., [0, 2], :2]
            rotated_cells = torch.einsum("bvij,hwj->bvhwi", rotations, cells)
            # Camera positions stay in metres, or become cells of the camera maps.
            unit = 1.0 if self.released_units else self.view_pixel_m
            offsets = matrices[..., [0, 2], 3] / unit  # (B, V, 2)
            right, depth = (rotated_cells + offsets[:, :, None, None]).unbind(dim=-1)
        height, width = self.view_size
        # Column 0 is an eighth of the length ahead of the camera, which is in the middle row.
        return torch.stack([depth - width / 8, right + height / 2], dim=-1)

    def cell_coordinates(self, device: torch.device) -> Tensor:
        """Return x and y of each BEV cell in the ground frame, in cells of a camera map.

        As in the released code, the centres of the outer cells lie on the border of the map.
        (H, W, 2)
        """
        unit = self.view_pixel_m
        x_low, x_high = self.grid.x_range
        y_low, y_high = self.grid.y_range
        x = torch.linspace(x_low / unit, x_high / unit, steps=self.grid.width, device=device)
        y = torch.linspace(y_low / unit, y_high / unit, steps=self.grid.height, device=device)
        return torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)


def sample_maps(maps: Tensor, positions: Tensor) -> Tensor:
    """Sample maps bilinearly.

    As in the released code, values at the last row or column and beyond it are 0.

    Args:
        maps: Maps. (n, C, h, w)
        positions: Continuous columns and rows. (n, H, W, 2)

    Returns:
        Sampled values. (n, C, H, W)
    """
    last = constant(positions, [maps.shape[-1] - 1, maps.shape[-2] - 1])
    inside = ((positions >= 0) & (positions < last)).all(dim=-1)
    positions_norm = 2 * positions / last - 1  # [-1, 1] over the map
    values = F.grid_sample(maps, positions_norm, align_corners=True)
    return values * inside[:, None]
