"""PivotNet's BEV encoder: deformable layers over all cameras side by side."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from mmdet3d.registry import MODELS
from torch import Tensor, nn

from gsmap.models.encoders.camera_encoder import CameraEncoder
from gsmap.models.encoders.projection import project_pillars
from gsmap.models.maptr.attention import (
    SamplingAttention,
    directional_offsets,
    place_samples,
    sample_map,
)
from gsmap.models.maptr.layers import feed_forward, init_matrices
from gsmap.models.pivotnet.front import centres, front_size, turned
from gsmap.structures.grid import BEVGrid

Shapes = Sequence[tuple[int, int]]


class Levels(NamedTuple):
    """Feature maps one after another, and their rows and columns."""

    tokens: Tensor  # (B, all cells, C)
    shapes: Shapes

    @property
    def sizes(self) -> list[int]:
        """Number of cells of each map."""
        return [height * width for height, width in self.shapes]


class LevelsAttention(SamplingAttention):
    """Deformable attention over several maps; arguments as in `SamplingAttention`."""

    def __init__(self, num_levels: int = 1, num_points: int = 8, **kwargs: Any) -> None:
        self.num_levels = num_levels
        super().__init__(num_points=num_levels * num_points, **kwargs)

    def initial_offsets(self) -> Tensor:
        """Return the same offsets for every map. (heads, levels * S, 2)"""
        offsets = directional_offsets(self.num_heads, self.num_points // self.num_levels)
        return offsets.repeat(1, self.num_levels, 1)

    def forward(self, query: Tensor, reference: Tensor, levels: Levels) -> Tensor:
        """Sample the maps around references, [0, 1] over each. (B, Q, C), (B, Q, 2) -> (B, Q, C)"""
        parts = zip(
            self.values(levels.tokens).split(levels.sizes, 1),
            levels.shapes,
            self.offsets_in_cells(query).chunk(self.num_levels, 3),
            self.weights(query).chunk(self.num_levels, 3),
            strict=True,
        )
        seen: list[Tensor] = [
            sample_map(values, shape, place_samples(offsets, reference, shape), weights)
            for values, shape, offsets, weights in parts
        ]
        return self.dropout(self.output_proj(torch.stack(seen).sum(0)))


class DeformableLayer(nn.Module):
    """Attention to the own maps, then perhaps to others, and a feed-forward network, post-norm."""

    def __init__(self, levels: Sequence[int], ffn_dims: int, dropout: float, **sizes: int) -> None:
        super().__init__()
        self.attns = nn.ModuleList(
            LevelsAttention(number, dropout=dropout, **sizes) for number in levels
        )
        self.ffn = feed_forward(sizes["embed_dims"], ffn_dims, dropout)
        norms = len(levels) + 1
        self.norms = nn.ModuleList(nn.LayerNorm(sizes["embed_dims"]) for _ in range(norms))

    def forward(
        self, own: Levels, position: Tensor, references: Sequence[Tensor], other: Levels | None
    ) -> Tensor:
        """Update tokens by maps at references (B, Q, 2) in each; values have no position."""
        tokens = own.tokens
        for attn, norm, reference, levels in zip(
            self.attns, self.norms, references, (own, other), strict=False
        ):
            tokens = norm(tokens + attn(tokens + position, reference, levels))
        return self.norms[-1](self.ffn(tokens))


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
            raise ValueError(f"camera_by must be 'depth' or 'angle', got {camera_by!r}.")
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
        levels = len(strides)
        self.source_layers, self.bev_layers = (
            nn.ModuleList(DeformableLayer(seen, **settings) for _ in range(number))
            for seen, number in zip(((levels,), (1, levels)), num_layers, strict=True)
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

    def levels_of(self, mlvl_feats: Sequence[Tensor]) -> Sequence[Tensor]:
        """Return all feature maps."""
        return mlvl_feats

    def encode(
        self,
        feats: Sequence[Tensor],
        calibration: Mapping[str, Tensor],
        img_shape: tuple[int, int],
    ) -> dict[str, Any]:
        """Encode feature maps, each (B, V, C, h, w), with ``img_from_ground`` (B, V, 4, 4).

        ValueError if they have other sizes than the position tables.
        """
        memory = self.sources(feats)
        position = self.bev_pos.weight
        reference = self.references(calibration["img_from_ground"], img_shape)
        shape, batch = front_size(self.grid), len(memory.tokens)
        own = centres(shape, position.device).expand(batch, -1, -1)
        cells = self.bev_embedding.weight.expand(batch, -1, -1)
        bev = []
        for layer in self.bev_layers:
            cells = layer(Levels(cells, [shape]), position, (own, reference), memory)
            bev.append(turned(cells.transpose(1, 2).unflatten(2, shape), self.grid))
        return {"bev_feats": bev[-1], "bev_levels": bev}

    def sources(self, feats: Sequence[Tensor]) -> Levels:
        """Return the cameras side by side, mixed."""
        joined = [f.permute(0, 2, 3, 1, 4).flatten(3) for f in feats]  # (B, C, h, V * w)
        found = [tuple(f.shape[-2:]) for f in joined]
        if found != self.shapes:
            raise ValueError(
                f"cameras side by side must have {self.shapes} feature pixels, not {found}: set "
                "image_size, strides and num_cams of PivotBEVEncoder to those of the images."
            )
        tokens = [
            project(f).flatten(2).transpose(1, 2)
            for project, f in zip(self.input_proj, joined, strict=True)
        ]
        position = torch.cat([table.weight for table in self.source_pos])
        # as released, the content has the position too
        memory = Levels(torch.cat(tokens, 1) + position, self.shapes)
        reference = torch.cat([centres(shape, position.device) for shape in self.shapes])
        reference = reference.expand(len(memory.tokens), -1, -1)
        for layer in self.source_layers:
            memory = memory._replace(tokens=layer(memory, position, (reference,), None))
        return memory

    def references(self, img_from_ground: Tensor, img_shape: tuple[int, int]) -> Tensor:
        """Return where cells look, [0, 1] over the cameras side by side. (B, H * W, 2)"""
        uv, seen = self.project(img_from_ground, img_shape)
        learned = self.unseen_reference(self.bev_pos.weight).sigmoid()
        return torch.where(seen[..., None], uv, learned)

    def project(self, img_from_ground: Tensor, img_shape: tuple[int, int]) -> tuple[Tensor, Tensor]:
        """Return each cell's centre in its camera, [0, 1] over all, and whether that sees it.

        (B, H * W, 2), (B, H * W)
        """
        places = centres(front_size(self.grid), img_from_ground.device).flip(-1)
        ground = self.grid.metres_from_front(places)
        points = torch.cat([ground, ground.new_tensor([0.0, 1.0]).expand(len(ground), 2)], -1)
        projection = project_pillars(points[:, None], img_from_ground, img_shape)
        # the third row of a matrix to pixels gives the depth
        along = torch.einsum("bvd,qd->bvq", img_from_ground[:, :, 2].float(), points)
        if self.camera_by == "angle":
            matrix, shift = (
                img_from_ground[..., :3, :3].float(),
                img_from_ground[..., :3, 3:].float(),
            )
            cameras = -torch.linalg.solve(matrix, shift)[..., 0]  # where they stand (B, V, 3)
            along = along / torch.cdist(cameras, points[None, :, :3].expand(len(cameras), -1, -1))
        camera = along.argmax(1, keepdim=True)  # (B, 1, Q)
        seen = projection.visible.gather(1, camera)[:, 0]
        place = projection.uv[..., 0, :]  # (B, V, Q, 2)
        uv = place.gather(1, camera[..., None].expand(-1, -1, -1, 2))[:, 0]
        number = camera[:, 0] / img_from_ground.shape[1]
        return torch.stack([uv[..., 0] / img_from_ground.shape[1] + number, uv[..., 1]], -1), seen
