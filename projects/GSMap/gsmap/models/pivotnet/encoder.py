"""PivotNet's BEV encoder: deformable layers over all cameras side by side."""

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
from gsmap.models.lines.front import centres, front_size, turned
from gsmap.structures.grid import BEVGrid
from gsmap.utils.errors import InputError

Shapes = Sequence[tuple[int, int]]


class DeformableLayer(nn.Module):
    """Attentions to maps, one after another, and a feed-forward network, post-norm."""

    def __init__(self, levels: Sequence[int], ffn_dims: int, dropout: float, **sizes: int) -> None:
        super().__init__()
        self.attns = nn.ModuleList(
            MultiLevelAttention(number, dropout=dropout, **sizes) for number in levels
        )
        self.ffn = feed_forward(sizes["embed_dims"], ffn_dims, dropout)
        self.norms = nn.ModuleList(nn.LayerNorm(sizes["embed_dims"]) for _ in (*levels, "ffn"))

    def forward(
        self, tokens: Tensor, position: Tensor, *views: tuple[Sequence[Tensor], Tensor]
    ) -> Tensor:
        """Update tokens (B, Q, C) by maps (B, C, h, w) at references (B, Q, 2) in each of them."""
        *norms, last = self.norms
        for attn, norm, (maps, reference) in zip(self.attns, norms, views, strict=True):
            tokens = norm(tokens + attn(tokens + position, reference, maps))
        return last(self.ffn(tokens))


@MODELS.register_module()
class PivotBEVEncoder(CameraEncoder):
    """Mix the cameras side by side, then let BEV cells look at them (PivotNet).

    A cell looks around the place of its centre on the ground in one camera, or around a learned one
    if that camera does not see it. Besides ``bev_feats`` there are ``bev_levels``, what each of the
    BEV layers returns.

    Args:
        grid: The map's extent.
        image_size: Rows and columns of the (padded) images.
        in_channels: Channels of the feature maps.
        strides: Image pixels per pixel of each.
        bev_pixel_m: Side of a BEV cell in metres.
        num_cams: Number of cameras, neighbours side by side.
        num_layers: Layers over the cameras, and BEV layers.
        layer_cfg: ``num_heads``, ``num_points`` per map, ``ffn_dims``, ``dropout`` of all layers.
        camera_by: The camera that a cell looks at: that in which it has the largest ``"depth"``, as
            released, or is nearest to the optical axis (``"angle"``), as intended.

    Raises:
        ValueError: If ``camera_by`` is unknown.
    """

    calibration = ("img_from_ground",)
    num_levels = None

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
        self.grid, self.camera_by = grid.rasterized(bev_pixel_m), camera_by
        self.shapes = [(image_size[0] // s, num_cams * (image_size[1] // s)) for s in strides]
        self.input_proj = nn.ModuleList(
            nn.Sequential(
                nn.Conv2d(channels, embed_dims, 1, bias=False), nn.BatchNorm2d(embed_dims)
            )
            for channels in in_channels
        )
        self.source_pos = nn.ModuleList(
            nn.Embedding(height * width, embed_dims) for height, width in self.shapes
        )
        defaults = {"num_heads": 8, "num_points": 8, "ffn_dims": 1024, "dropout": 0.1}
        settings = {"embed_dims": embed_dims, **defaults, **(layer_cfg or {})}
        self.source_layers, self.bev_layers = (
            nn.ModuleList(DeformableLayer(levels, **settings) for _ in range(number))
            for levels, number in zip(((len(strides),), (1, len(strides))), num_layers, strict=True)
        )
        cells = self.grid.height * self.grid.width
        self.bev_embedding = nn.Embedding(cells, embed_dims)
        self.bev_pos = nn.Embedding(cells, embed_dims)
        self.unseen_reference = nn.Linear(embed_dims, 2)

    def init_weights(self) -> None:
        """Initialise the matrices (Xavier); tables of positions and of cells stay normal."""
        super().init_weights()
        for part in (self.source_layers, self.bev_layers, self.unseen_reference):
            init_matrices(part)

    def encode(
        self, feats: Sequence[Tensor], calibration: Mapping[str, Tensor], img_shape: tuple[int, int]
    ) -> dict[str, Any]:
        """Encode feature maps, each (B, V, C, h, w), with ``img_from_ground`` (B, V, 4, 4).

        ValueError if they have other sizes than the position tables.
        """
        sources, position = self.sources(feats), self.bev_pos.weight
        uv, seen = self.project(calibration["img_from_ground"], img_shape)
        reference = torch.where(seen[..., None], uv, self.unseen_reference(position).sigmoid())
        shapes = [front_size(self.grid)]
        own = centres(shapes, position.device).expand_as(reference)
        cells, bev = self.bev_embedding.weight.expand(len(uv), -1, -1), []
        for layer in self.bev_layers:
            cells = layer(cells, position, (maps_of(cells, shapes), own), (sources, reference))
            bev.append(turned(maps_of(cells, shapes)[0], self.grid))
        return {"bev_feats": bev[-1], "bev_levels": bev}

    def sources(self, feats: Sequence[Tensor]) -> list[Tensor]:
        """Return the cameras side by side, mixed. (B, C, h, V * w) each"""
        joined = [f.permute(0, 2, 3, 1, 4).flatten(3) for f in feats]
        found = [tuple(f.shape[-2:]) for f in joined]
        if found != self.shapes:
            raise InputError(
                f"the cameras side by side must have {self.shapes} feature pixels, not {found}; "
                "set image_size, strides and num_cams of PivotBEVEncoder to those of the images."
            )
        maps = zip(self.input_proj, joined, strict=True)
        tokens = torch.cat([project(f).flatten(2) for project, f in maps], 2).transpose(1, 2)
        position = torch.cat([*self.source_pos.parameters()])
        tokens = tokens + position  # as released, the content has the position too
        reference = centres(self.shapes, position.device).expand(len(tokens), -1, -1)
        for layer in self.source_layers:
            tokens = layer(tokens, position, (maps_of(tokens, self.shapes), reference))
        return maps_of(tokens, self.shapes)

    def project(self, img_from_ground: Tensor, img_shape: tuple[int, int]) -> tuple[Tensor, Tensor]:
        """Return each cell's centre in its camera, [0, 1] over all, and whether that sees it.

        (B, H * W, 2), (B, H * W)
        """
        matrices = img_from_ground.float()
        places = centres([front_size(self.grid)], matrices.device).flip(-1)
        points = F.pad(self.grid.metres_from_front(places), (0, 1))  # on the ground
        points = F.pad(points, (0, 1), value=1.0)  # (Q, 4)
        uv, visible = project_pillars(points[:, None], matrices, img_shape)
        score = torch.einsum("bvd,qd->bvq", matrices[:, :, 2], points)  # the depth
        if self.camera_by == "angle":
            cameras = torch.linalg.inv(matrices)[..., :3, 3]  # where they stand (B, V, 3)
            score = score / torch.cdist(cameras, points[None, :, :3].expand(len(cameras), -1, -1))
        camera = score.argmax(1, keepdim=True)  # (B, 1, Q)
        u, v = (part.gather(1, camera)[:, 0] for part in uv[..., 0, :].unbind(-1))
        u = (u + camera[:, 0]) / matrices.shape[1]
        return torch.stack([u, v], -1), visible.gather(1, camera)[:, 0]


def maps_of(tokens: Tensor, shapes: Shapes) -> list[Tensor]:
    """Return the maps whose cells stand one after another. (B, cells, C) -> (B, C, h, w) each"""
    parts = tokens.transpose(1, 2).split([height * width for height, width in shapes], 2)
    return [part.unflatten(2, shape) for part, shape in zip(parts, shapes, strict=True)]
