"""BEV encoder with one learned query per cell, which attends to other cells and to the cameras."""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import torch
from mmdet.models.layers import LearnedPositionalEncoding
from mmdet3d.registry import MODELS
from torch import Tensor, nn

from gsmap.models.base.attention import BEVDeformableAttention
from gsmap.models.base.layers import feed_forward, init_matrices
from gsmap.models.encoders.camera_encoder import CameraEncoder
from gsmap.models.encoders.projection import PillarProjection, pillar_points, project_pillars
from gsmap.structures.calibration import NUM_CAN_BUS
from gsmap.structures.grid import BEVGrid
from gsmap.utils.errors import InputError


class BEVSelfAttention(BEVDeformableAttention):
    """Temporal self-attention of BEVFormer, for a model without history.

    BEVFormer attends to a queue of two entries, the BEV features of the previous frame and the
    current queries, and averages the two outputs. Without history both entries are the current
    queries. The average then equals one attention over the samples of both entries at half the
    weight.

    Args:
        embed_dims: Channels C.
        num_heads: Number of heads.
        num_points: Samples per head and entry of the queue.
        dropout: Probability to drop a channel of the output in training.
    """

    def __init__(
        self, embed_dims: int = 256, num_heads: int = 8, num_points: int = 4, dropout: float = 0.1
    ) -> None:
        super().__init__(
            embed_dims,
            num_heads=num_heads,
            num_points=num_points,
            query_dims=2 * embed_dims,
            dropout=dropout,
            num_parts=2,  # entries of the queue
        )

    def weights(self, query: Tensor) -> Tensor:
        """Attention weights: a softmax per entry of the queue, divided by the number of entries.

        `forward` of the base class calls this method.

        Args:
            query: Both entries of the queue, concatenated along the channels. (B, Q, 2 C)

        Returns:
            Weights that sum to 1 over the S samples of both entries. (B, Q, heads, S)
        """
        logits = self.attention_weights(query).float()
        # (B, Q, heads, 2, S / 2): the samples of each entry of the queue
        logits = logits.unflatten(-1, (self.num_heads, self.num_parts, -1))
        return logits.softmax(-1).flatten(-2) / self.num_parts


class BEVEncoderLayer(nn.Module):
    """Self-attention, camera cross-attention and feed-forward network, each with its LayerNorm.

    Args:
        cross_attn: Config of the camera cross-attention.
        embed_dims: Channels C.
        num_heads: Heads of the self-attention.
        num_points: Samples of the self-attention, per head and entry of its queue.
        ffn_dims: Hidden channels of the feed-forward network.
        dropout: Probability to drop a value in training.
        released_pairs: By default, the self-attention reads the queries of each sample concatenated
            with themselves. If True, the first half of the channels of sample b is taken from
            sample floor(b / 2), as in the released code of BEVFormer. The result of a sample then
            depends on the other samples of its batch.
    """

    def __init__(
        self,
        cross_attn: dict,
        embed_dims: int = 256,
        num_heads: int = 8,
        num_points: int = 4,
        ffn_dims: int = 512,
        dropout: float = 0.1,
        released_pairs: bool = False,
    ) -> None:
        super().__init__()
        self.released_pairs = released_pairs
        self.self_attn = BEVSelfAttention(
            embed_dims, num_heads=num_heads, num_points=num_points, dropout=dropout
        )
        self.cross_attn = MODELS.build({"embed_dims": embed_dims, **cross_attn})
        self.dropout = nn.Dropout(dropout)
        self.ffn = feed_forward(embed_dims, ffn_dims, dropout)
        self.norms = nn.ModuleList(nn.LayerNorm(embed_dims) for _ in range(3))

    def forward(
        self,
        query: Tensor,
        query_pos: Tensor,
        grid: BEVGrid,
        feats: Any,
        projection: PillarProjection,
    ) -> Tensor:
        """Update the queries of all cells.

        Args:
            query: Queries of the cells, row by row. (B, Q, C)
            query_pos: Positional encoding of the cells. (1, Q, C)
            grid: The cells, H x W = Q.
            feats: Image features with the embeddings of camera and level. (B, V, C, h, w), or a
                list with one such tensor per level
            projection: Image coordinates of the pillars (vertical rows of points above the cells),
                and the visible cells of each camera.

        Returns:
            The updated queries. (B, Q, C)
        """
        centres = self.centres(grid, query.device).view(1, -1, 2)
        partner = query
        if self.released_pairs:
            # Entry b has the queries of sample floor(b / 2): samples 0, 0, 1, 1, ...
            partner = query.repeat_interleave(2, 0)[: len(query)]
        pair = torch.cat([partner, query + query_pos], dim=-1)  # (B, Q, 2 C)
        bev = query.transpose(1, 2).unflatten(-1, (grid.height, grid.width))  # (B, C, H, W)
        # The self-attention includes its dropout, and the feed-forward network its residual.
        query = self.norms[0](query + self.self_attn(pair, centres, bev))
        query = self.norms[1](query + self.dropout(self.cross_attn(query, feats, projection)))
        return self.norms[2](self.ffn(query))

    def centres(self, grid: BEVGrid, device: torch.device) -> Tensor:
        """Centre of each cell, the reference point of its self-attention, [0, 1]. (H, W, 2)"""
        return grid.norm_from_metres(grid.pixel_centres(device))


@MODELS.register_module()
class BEVQueryEncoder(CameraEncoder):
    """BEV encoder with a learned query per cell: BEVFormer without history, or GKT.

    ``cross_attn`` selects one of the two. A pillar is the vertical row of points above a cell that
    is projected into the cameras.

    Args:
        cross_attn: Config of the camera cross-attention of every layer.
        grid: Extent of the map.
        z_range: Lowest and highest z of the pillars in metres.
        bev_pixel_m: Side of a cell in metres, or its sizes along x and y.
        embed_dims: Channels C.
        num_layers: Number of layers.
        layer_cfg: Further arguments of :class:`BEVEncoderLayer`.
        num_cams: Number of cameras V.
        with_can_bus: Add an embedding of the motion signals of the vehicle to the queries.
        num_levels: Number of levels of image features that are used, at most 4.
        uniform_positions: Initialise the positional encoding from U[0, 1), as intended by
            BEVFormer. MapTR and its successors start from N(0, 1), because their code leaves the
            default of ``nn.Embedding``.
        init_cfg: Initialisation config of mmengine.
    """

    layer_class: ClassVar[type[BEVEncoderLayer]] = BEVEncoderLayer

    def __init__(
        self,
        cross_attn: dict,
        grid: BEVGrid,
        z_range: Sequence[float] = (-2.0, 2.0),
        bev_pixel_m: float | Sequence[float] = 0.3,
        embed_dims: int = 256,
        num_layers: int = 1,
        layer_cfg: dict | None = None,
        num_cams: int = 6,
        with_can_bus: bool = True,
        num_levels: int = 1,
        uniform_positions: bool = False,
        init_cfg: dict | None = None,
    ) -> None:
        super().__init__(init_cfg)
        self.grid = grid.rasterized(bev_pixel_m)
        self.z_range = (float(z_range[0]), float(z_range[1]))
        self.bev_embedding = nn.Embedding(self.grid.height * self.grid.width, embed_dims)
        position_init: dict[str, Any] = {"type": "Normal", "layer": "Embedding", "std": 1.0}
        if uniform_positions:
            position_init = {"type": "Uniform", "layer": "Embedding"}
        self.positional_encoding = LearnedPositionalEncoding(
            embed_dims // 2,  # channels for the column, and as many for the row
            self.grid.height,
            self.grid.width,
            init_cfg=position_init,
        )
        # The released models have embeddings of four levels. The first ``num_levels`` are used.
        self.level_embeds = nn.Parameter(torch.empty(4, embed_dims))
        self.cams_embeds = nn.Parameter(torch.empty(num_cams, embed_dims))
        self.calibration = ("img_from_frame",)  # names of the arrays that `encode` reads
        self.can_bus_mlp = None
        if with_can_bus:
            self.calibration = ("img_from_frame", "can_bus")
            self.can_bus_mlp = nn.Sequential(
                nn.Linear(NUM_CAN_BUS, embed_dims // 2),
                nn.ReLU(inplace=True),
                nn.Linear(embed_dims // 2, embed_dims),
                nn.ReLU(inplace=True),
            )
            # Named as in the released code, so that its weights can be loaded.
            self.can_bus_mlp.add_module("norm", nn.LayerNorm(embed_dims))
        self.num_levels = num_levels  # the base class takes this number of levels as `feats`
        layer = {"cross_attn": cross_attn, "embed_dims": embed_dims, **(layer_cfg or {})}
        layers = []
        for _ in range(num_layers):
            layers.append(self.layer_class(**layer))
        # Number of points per pillar, which the cross-attention determines.
        self.num_heights: int = layers[0].cross_attn.num_heights
        self.layers = nn.ModuleList(layers)
        nn.init.normal_(self.level_embeds)
        nn.init.normal_(self.cams_embeds)

    def init_weights(self) -> None:
        """Initialise the matrices of the layers from Xavier's uniform distribution."""
        super().init_weights()
        init_matrices(self.layers)
        if self.can_bus_mlp is not None:
            init_matrices(self.can_bus_mlp)

    def encode(
        self, feats: Any, calibration: Mapping[str, Tensor], img_shape: tuple[int, int]
    ) -> dict[str, Tensor]:
        """Encode image features as BEV features.

        Args:
            feats: Image features. (B, V, C, h, w), or a list with one such tensor per level
            calibration: ``img_from_frame`` (B, V, 4, 4), and ``can_bus`` (B, 18) if the encoder
                uses it.
            img_shape: Rows and columns of the padded images.

        Returns:
            ``bev_feats`` (B, C, H, W), and the input as ``img_feats``.

        Raises:
            ValueError: If the number of cameras differs from ``num_cams``.
        """
        first = feats if isinstance(feats, Tensor) else feats[0]
        if first.shape[1] != len(self.cams_embeds):
            raise InputError(
                f"the encoder is built for {len(self.cams_embeds)} cameras, got {first.shape[1]}: "
                "set num_cams of the encoder."
            )
        codes = self.cams_embeds + self.level_embeds[:, None]  # (4, V, C)
        codes = codes[..., None, None].to(first.dtype)
        if isinstance(feats, Tensor):
            tokens: Any = feats + codes[0]
        else:
            # There are codes of four levels, and `feats` may have fewer.
            tokens = [level + code for level, code in zip(feats, codes, strict=False)]
        bev_shape = (self.grid.height, self.grid.width)
        query = self.bev_embedding.weight.expand(len(first), -1, -1)  # (B, Q, C)
        if self.can_bus_mlp is not None:
            query = query + self.can_bus_mlp(calibration["can_bus"])[:, None]
        # mmdet's encoding takes a padding mask, of which only the shape is used.
        query_pos = self.positional_encoding(first.new_zeros((1, *bev_shape)))
        query_pos = query_pos.flatten(2).transpose(1, 2)  # (1, Q, C)
        projection = self.project(calibration["img_from_frame"], img_shape)
        for layer in self.layers:
            query = layer(query, query_pos, grid=self.grid, feats=tokens, projection=projection)
        bev_feats = query.transpose(1, 2).unflatten(-1, bev_shape)
        return {"bev_feats": bev_feats, "img_feats": feats}

    def project(self, img_from_frame: Tensor, img_shape: tuple[int, int]) -> PillarProjection:
        """Project the pillar of every cell into every camera.

        Args:
            img_from_frame: Matrices from metres to pixels. (B, V, 4, 4)
            img_shape: Rows and columns of the padded images.
        """
        pillars = pillar_points(
            grid=self.grid,
            z_range=self.z_range,
            num_heights=self.num_heights,
            device=img_from_frame.device,
        )
        return project_pillars(pillars, img_from_frame, img_shape)
