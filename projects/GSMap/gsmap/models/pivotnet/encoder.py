"""PivotNet's BEV encoder: deformable attention over the feature maps of all cameras."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from mmdet3d.registry import MODELS
from torch import Tensor, nn

from gsmap.models.base.attention import MultiLevelAttention
from gsmap.models.base.layers import feed_forward, init_matrices
from gsmap.models.encoders.camera_encoder import CameraEncoder
from gsmap.models.encoders.projection import project_pillars
from gsmap.models.lines.front import centres, front_size, turn_raster
from gsmap.structures.grid import BEVGrid
from gsmap.utils.errors import InputError

Shapes = Sequence[tuple[int, int]]


class DeformableLayer(nn.Module):
    """Layer of successive deformable attentions and a feed-forward network, with post-norm.

    Args:
        levels: Number of feature maps that each attention samples.
        embed_dims: Channels C of the tokens and of the maps.
        num_heads: Number of attention heads.
        num_points: Number of samples per head and map.
        ffn_dims: Hidden channels of the feed-forward network.
        dropout: Probability of setting a value to zero in training, in [0, 1].
    """

    def __init__(
        self,
        levels: Sequence[int],
        embed_dims: int,
        num_heads: int,
        num_points: int,
        ffn_dims: int,
        dropout: float,
    ) -> None:
        super().__init__()
        self.attns = nn.ModuleList()
        for num_maps in levels:
            attn = MultiLevelAttention(
                num_maps,
                num_points=num_points,
                embed_dims=embed_dims,
                num_heads=num_heads,
                dropout=dropout,
            )
            self.attns.append(attn)
        self.ffn = feed_forward(embed_dims, ffn_dims, dropout=dropout)
        self.norms = nn.ModuleList(nn.LayerNorm(embed_dims) for _ in range(len(levels) + 1))

    def forward(
        self, tokens: Tensor, position: Tensor, *views: tuple[Sequence[Tensor], Tensor]
    ) -> Tensor:
        """Update tokens by the maps of each attention.

        Args:
            tokens: Tokens. (B, Q, C)
            position: Positional embeddings. (Q, C)
            views: For each attention, a pair of its maps, (B, C, h, w) each, and the references of
                the tokens in [0, 1] over each map (B, Q, 2).

        Returns:
            Updated tokens. (B, Q, C)
        """
        *norms, last_norm = self.norms
        for attn, norm, (maps, reference) in zip(self.attns, norms, views, strict=True):
            tokens = norm(tokens + attn(tokens + position, reference, feats=maps))
        return last_norm(self.ffn(tokens))  # `ffn` adds its input to its output


@MODELS.register_module()
class PivotBEVEncoder(CameraEncoder):
    """BEV encoder with deformable attention over the concatenated cameras (PivotNet).

    The feature maps of all cameras are concatenated from left to right. The concatenated maps, one
    per level, are called sources. A BEV cell attends around the projection of its centre on the
    ground into one camera, or around a learned reference if the projection is outside the image of
    this camera. In addition to ``bev_feats``, the encoder returns ``bev_levels``, the outputs of
    all BEV layers.

    Args:
        grid: Extent of the map, in metres.
        image_size: Rows and columns of the (padded) images.
        in_channels: Channels of each level of image features.
        strides: Image pixels per feature pixel of each level.
        bev_pixel_m: Side of a BEV cell in metres.
        embed_dims: Channels C of the BEV features.
        num_cams: Number V of cameras, in the order of concatenation.
        num_layers: Number of layers over the camera maps, and number of BEV layers after them.
        layer_cfg: Settings ``num_heads``, ``num_points`` per map, ``ffn_dims`` and ``dropout`` of
            all layers.
        camera_by: Choice of the camera of a cell: the one with the largest ``"depth"``, as in the
            released code, or with the smallest ``"angle"`` to the optical axis, as intended.
        init_cfg: Initialisation config of mmengine.

    Raises:
        ValueError: If ``camera_by`` is unknown.
    """

    calibration = ("img_from_ground",)
    num_levels = None  # all levels of image features

    def __init__(
        self,
        grid: BEVGrid,
        image_size: Sequence[int] = (512, 896),
        in_channels: Sequence[int] = (1024, 2048),
        strides: Sequence[int] = (16, 32),
        bev_pixel_m: float = 0.9375,
        embed_dims: int = 256,
        num_cams: int = 6,
        num_layers: Sequence[int] = (4, 4),
        layer_cfg: Mapping[str, Any] | None = None,
        camera_by: str = "depth",
        init_cfg: dict | None = None,
    ) -> None:
        super().__init__(init_cfg)
        if camera_by not in ("depth", "angle"):
            raise InputError(f"camera_by must be 'depth' or 'angle', got {camera_by!r}.")
        self.grid = grid.rasterized(bev_pixel_m)
        self.camera_by = camera_by
        self.shapes = []  # rows and columns of each source
        for stride in strides:
            height = image_size[0] // stride
            width = num_cams * (image_size[1] // stride)
            self.shapes.append((height, width))
        self.input_proj = nn.ModuleList()
        for channels in in_channels:
            conv = nn.Conv2d(channels, embed_dims, kernel_size=1, bias=False)
            self.input_proj.append(nn.Sequential(conv, nn.BatchNorm2d(embed_dims)))
        self.source_pos = nn.ModuleList()
        for height, width in self.shapes:
            self.source_pos.append(nn.Embedding(height * width, embed_dims))
        defaults = {"num_heads": 8, "num_points": 8, "ffn_dims": 1024, "dropout": 0.1}
        settings = {"embed_dims": embed_dims, **defaults, **(layer_cfg or {})}
        num_source_layers, num_bev_layers = num_layers
        num_levels = len(strides)
        # A source layer attends to the sources, a BEV layer to the BEV map and then to the sources.
        self.source_layers = nn.ModuleList(
            DeformableLayer(levels=[num_levels], **settings) for _ in range(num_source_layers)
        )
        self.bev_layers = nn.ModuleList(
            DeformableLayer(levels=[1, num_levels], **settings) for _ in range(num_bev_layers)
        )
        num_cells = self.grid.height * self.grid.width
        self.bev_embedding = nn.Embedding(num_cells, embed_dims)
        self.bev_pos = nn.Embedding(num_cells, embed_dims)
        self.unseen_reference = nn.Linear(embed_dims, 2)

    def init_weights(self) -> None:
        """Initialise matrices with Xavier's method; embeddings keep torch's initial values."""
        super().init_weights()
        for module in (self.source_layers, self.bev_layers, self.unseen_reference):
            init_matrices(module)

    def encode(
        self, feats: Sequence[Tensor], calibration: Mapping[str, Tensor], img_shape: tuple[int, int]
    ) -> dict[str, Any]:
        """Encode image features to BEV features.

        Args:
            feats: Levels of image features. (B, V, C', h, w) each
            calibration: ``img_from_ground``, transforms from the ground frame in metres to pixels.
                (B, V, 4, 4)
            img_shape: Rows and columns of the padded images.

        Returns:
            ``bev_feats`` (B, C, H, W) and ``bev_levels``, one map (B, C, H, W) for each BEV layer.

        Raises:
            ValueError: If the sizes of the features differ from the settings.
        """
        sources = self.sources(feats)
        position = self.bev_pos.weight
        uv, visible = self.project(calibration["img_from_ground"], img_shape)
        learned_reference = self.unseen_reference(position).sigmoid()
        source_reference = torch.where(visible[..., None], uv, learned_reference)  # (B, H * W, 2)
        # In this method, the BEV cells are in rows from the front to the rear of the map.
        # `turn_raster` brings the results into the layout of `grid`.
        shapes = [front_size(self.grid)]
        # Centres of the cells in [0, 1] over the BEV map, for the attention to the BEV map.
        cell_reference = centres(shapes, position.device).expand_as(source_reference)
        cells = self.bev_embedding.weight.expand(len(uv), -1, -1)  # (B, H * W, C)
        levels = []
        for layer in self.bev_layers:
            bev_view = (split_maps(cells, shapes), cell_reference)
            source_view = (sources, source_reference)
            cells = layer(cells, position, bev_view, source_view)
            levels.append(turn_raster(split_maps(cells, shapes)[0], self.grid))
        return {"bev_feats": levels[-1], "bev_levels": levels}

    def sources(self, feats: Sequence[Tensor]) -> list[Tensor]:
        """Concatenate the cameras from left to right and apply the layers over the cameras.

        Args:
            feats: Levels of image features. (B, V, C', h, w) each

        Returns:
            Maps of all cameras. (B, C, h, V * w) each

        Raises:
            ValueError: If the sizes of the features differ from the settings.
        """
        # (B, V, C', h, w) -> (B, C', h, V, w) -> (B, C', h, V * w)
        levels = [level.permute(0, 2, 3, 1, 4).flatten(3) for level in feats]
        shapes = [tuple(level.shape[-2:]) for level in levels]
        if shapes != self.shapes:
            raise InputError(
                f"the cameras side by side must have {self.shapes} feature pixels, not {shapes}; "
                "set image_size, strides and num_cams of PivotBEVEncoder to the values of the "
                "images."
            )
        pixels = []
        for project, level in zip(self.input_proj, levels, strict=True):
            pixels.append(project(level).flatten(2))
        tokens = torch.cat(pixels, dim=2).transpose(1, 2)  # (B, pixels of all levels, C)
        position = torch.cat(list(self.source_pos.parameters()))
        tokens = tokens + position  # as in the released code, where values include the position
        reference = centres(self.shapes, position.device).expand(len(tokens), -1, -1)
        for layer in self.source_layers:
            tokens = layer(tokens, position, (split_maps(tokens, self.shapes), reference))
        return split_maps(tokens, self.shapes)

    def project(self, img_from_ground: Tensor, img_shape: tuple[int, int]) -> tuple[Tensor, Tensor]:
        """Project the centres of the BEV cells on the ground into one camera each.

        Args:
            img_from_ground: Transforms from the ground frame in metres to pixels. (B, V, 4, 4)
            img_shape: Rows and columns of the padded images.

        Returns:
            Positions in [0, 1] over all concatenated cameras (B, H * W, 2), and whether each cell
            is inside the image of its camera. (B, H * W)
        """
        matrices = img_from_ground.float()
        # `flip` changes (position from the left, position from the front) to the reverse order.
        cell_centres = centres([front_size(self.grid)], matrices.device).flip(-1)  # (Q, 2)
        points = F.pad(self.grid.metres_from_front(cell_centres), (0, 1))  # z = 0
        points = F.pad(points, (0, 1), value=1.0)  # (Q, 4)
        # Each cell is a pillar of one point: uv in [0, 1] over each image, (B, V, Q, 1, 2), and
        # whether the point is inside the image, (B, V, Q).
        uv, visible = project_pillars(points[:, None], matrices, img_shape=img_shape)
        with torch.autocast(points.device.type, enabled=False):
            score = torch.einsum("bvd,qd->bvq", matrices[:, :, 2], points)  # the depth
        if self.camera_by == "angle":  # depth / distance is the cosine of the angle
            camera_positions = torch.linalg.inv(matrices)[..., :3, 3]  # (B, V, 3)
            ground = points[None, :, :3].expand(len(camera_positions), -1, -1)
            score = score / torch.cdist(camera_positions, ground)
        camera = score.argmax(dim=1, keepdim=True)  # (B, 1, Q)
        u_by_camera, v_by_camera = uv[..., 0, :].unbind(-1)  # (B, V, Q)
        u = u_by_camera.gather(1, camera)[:, 0]
        v = v_by_camera.gather(1, camera)[:, 0]
        num_cams = matrices.shape[1]
        u = (u + camera[:, 0]) / num_cams  # from one image to all images side by side
        is_inside = visible.gather(1, camera)[:, 0]
        return torch.stack([u, v], dim=-1), is_inside


def split_maps(tokens: Tensor, shapes: Shapes) -> list[Tensor]:
    """Split successive cells into maps of (rows, columns). (B, cells, C) -> (B, C, h, w) each"""
    sizes = [height * width for height, width in shapes]
    flat_maps = tokens.transpose(1, 2).split(sizes, dim=2)
    return [flat.unflatten(2, shape) for flat, shape in zip(flat_maps, shapes, strict=True)]
