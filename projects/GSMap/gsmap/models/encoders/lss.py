"""BEV encoder that lifts image features along predicted depth (Lift, Splat, Shoot)."""

from collections.abc import Mapping, Sequence
from typing import Any, cast

import torch
from mmdet3d.registry import MODELS
from torch import Tensor, nn

from gsmap.models.base.layers import init_matrices
from gsmap.models.encoders.camera_encoder import CameraEncoder
from gsmap.models.encoders.depth_net import CameraAwareDepthNet, PlainDepthNet, camera_vector
from gsmap.models.encoders.projection import frustum_points
from gsmap.ops.bev_pool import bev_pool_conv3x3, cell_indices
from gsmap.structures.grid import BEVGrid
from gsmap.structures.tensors import num_depth_bins

# Arguments of `camera_vector`, which makes the input of the camera-aware depth net.
CAMERA_MATRICES = ("cam2img", "img_aug_matrix", "ego_from_cam")


@MODELS.register_module()
class LSSEncoder(CameraEncoder):
    """BEV encoder that lifts image features by predicted depth and sums them in BEV cells.

    Three convolutions refine the sums. The features are summed in cells with half the side of the
    output's cells, and the second convolution has stride 2.

    Args:
        grid: Extent of the map; points outside are dropped.
        z_range: Lowest and highest z of the points in metres.
        bev_pixel_m: Side of a cell of the output in metres, or its sizes along x and y.
        embed_dims: Channels C of image and BEV features.
        depth_range: ``(low, high, step)`` of the depth bins in metres.
        camera_aware: Whether the depth net uses the camera parameters. Otherwise, it is one
            convolution, as in the BEVPool variant of MapTR.
        aspp_channels: Channels of each branch of the spatial pyramid (ASPP) in the camera-aware
            depth net.
        init_cfg: Initialisation config of mmengine.

    Raises:
        ValueError: If ``depth_range`` contains no bin.
    """

    # Whether the sizes of tensors must not depend on values, as in a CUDA graph. Points are then
    # scattered into cells instead of sorted by cell. The code that records a graph sets it to True.
    fixed_sizes = False

    def __init__(
        self,
        grid: BEVGrid,
        z_range: Sequence[float] = (-10.0, 10.0),
        bev_pixel_m: float | Sequence[float] = 0.3,
        embed_dims: int = 256,
        depth_range: tuple[float, float, float] = (1.0, 35.0, 0.5),
        camera_aware: bool = True,
        aspp_channels: int = 96,
        init_cfg: dict | None = None,
    ) -> None:
        super().__init__(init_cfg)
        self.grid = grid.rasterized(bev_pixel_m)
        # Cells in which features are summed: half the side of the output's cells.
        self.cells = self.grid.with_size(2 * self.grid.height, 2 * self.grid.width)
        self.z_range = (float(z_range[0]), float(z_range[1]))
        low, high, step = depth_range
        self.depth_range = (float(low), float(high), float(step))
        self.num_bins = num_depth_bins(self.depth_range)
        self.camera_aware = camera_aware
        # Names of the matrices that the base class collects and passes to `encode`.
        self.calibration = ("frame_from_img",)
        if camera_aware:
            self.calibration += CAMERA_MATRICES
        channels = {
            "in_channels": embed_dims,
            "context_channels": embed_dims,
            "depth_channels": self.num_bins,
        }
        self.depth_net: CameraAwareDepthNet | PlainDepthNet
        if camera_aware:
            self.depth_net = CameraAwareDepthNet(aspp_channels=aspp_channels, **channels)
        else:
            self.depth_net = PlainDepthNet(**channels)
        blocks = nn.Sequential()
        for stride in (1, 2, 1):
            blocks.append(
                nn.Conv2d(
                    embed_dims, embed_dims, kernel_size=3, stride=stride, padding=1, bias=False
                )
            )
            blocks.append(nn.BatchNorm2d(embed_dims))
            blocks.append(nn.ReLU(inplace=True))
        self.downsample = blocks

    def init_weights(self) -> None:
        """Initialise matrices and kernels from Xavier's uniform distribution."""
        super().init_weights()
        init_matrices(self)

    def encode(
        self, feats: Tensor, calibration: Mapping[str, Tensor], img_shape: tuple[int, int]
    ) -> dict[str, Any]:
        """Encode image features as BEV features.

        Args:
            feats: Image features. (B, V, C, h, w)
            calibration: ``frame_from_img`` (B, V, 4, 4), and ``CAMERA_MATRICES`` if the encoder is
                camera-aware.
            img_shape: Rows and columns of the padded images.

        Returns:
            ``bev_feats`` (B, C, H, W); ``depth``, the probability of each depth bin
            (B, V, D, h, w), and its ``depth_range``; the input as ``img_feats``.
        """
        vectors = None
        if self.camera_aware:
            matrices = {name: calibration[name] for name in CAMERA_MATRICES}
            vectors = camera_vector(**matrices).flatten(0, 1)  # (B * V, 22)
        # Logits of the D depth bins (B * V, D, h, w), and features to lift (B * V, C, h, w).
        logits, context = self.depth_net(feats.flatten(0, 1), vectors)
        depth = logits.float().softmax(1).unflatten(0, feats.shape[:2])  # (B, V, D, h, w)
        context = context.float().unflatten(0, feats.shape[:2])  # (B, V, C, h, w)
        points = self.points(calibration["frame_from_img"], img_shape, feats)
        # Index of the cell of each point, -1 outside of the grid or of `z_range`. (B, V, D, h, w)
        indices = cell_indices(points, self.cells, self.z_range)
        # The first convolution is computed together with the sums, which needs fewer operations.
        # The other layers of `downsample` follow below. The sums need float32, so autocast is off.
        with torch.autocast(feats.device.type, enabled=False):
            kernel = cast(Tensor, self.downsample[0].weight)
            bev = bev_pool_conv3x3(
                depth,
                context,
                cells=indices,
                grid=self.cells,
                weight=kernel.float(),
                fixed_sizes=self.fixed_sizes,
            )
        return {
            "bev_feats": self.downsample[1:](bev),
            "depth": depth,
            "depth_range": self.depth_range,
            "img_feats": feats,
        }

    def points(self, frame_from_img: Tensor, img_shape: tuple[int, int], feats: Tensor) -> Tensor:
        """Compute the points of every feature pixel at every depth, in the annotation frame.

        Args:
            frame_from_img: Matrices from (u * d, v * d, d, 1) to metres. (B, V, 4, 4)
            img_shape: Rows and columns of the padded images.
            feats: Image features, of which only the size and the device are used. (B, V, C, h, w)

        Returns:
            Points in metres. (B, V, D, h, w, 3)
        """
        low, high, step = self.depth_range
        # Rounding decides whether `high` itself is in `arange`, so one more depth is computed.
        depths_m = torch.arange(low, high + step, step, device=feats.device)[: self.num_bins]
        return frustum_points(
            frame_from_img,
            image_size=img_shape,
            feature_size=(feats.shape[-2], feats.shape[-1]),
            depths_m=depths_m,
        )
