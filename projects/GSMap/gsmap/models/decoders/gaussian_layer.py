"""GSMap's decoder layer: one layer's Gaussians guide where the next looks (section 3.4)."""

from typing import Any

from mmdet3d.registry import MODELS
from mmengine.model import constant_init
from torch import Tensor, nn

from gsmap.models.decoders.map_decoder import MapDecoderLayer
from gsmap.models.layers.deformable_attention import DeformableAttention
from gsmap.structures.gaussians import GaussianSpace


class GaussianDeformableAttention(DeformableAttention):
    """Deformable attention whose sampling offsets live in each Gaussian's own frame.

    Args:
        space: How the reference stands for a Gaussian.
        args: As in `DeformableAttention`.
        kwargs: As in `DeformableAttention`.
    """

    def __init__(self, space: GaussianSpace, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.space = space

    def sampling_locations(
        self, query: Tensor, reference: Tensor, shape: tuple[int, int]
    ) -> Tensor:
        """Place samples around the centres; their offsets turn and stretch with the Gaussians.

        Args:
            query: Query with its position added. (B, Q, C)
            reference: Reference. (B, Q, 5)
            shape: Rows and columns of the map.

        Returns:
            Sampling points (x, y), [0, 1] over the map. (B, Q, heads, S, 2)
        """
        cell_m = reference.new_tensor(self.space.grid.resized(*shape).pixel_size_m)
        # The frames act on metres; brought to cells, the identity stays the identity bit by bit.
        frames = self.space.frames(reference) * (cell_m / cell_m[:, None])  # (B, Q, 2, 2)
        offsets = self.offsets_in_cells(query)  # (B, Q, heads, S, 2)
        turned = (frames[:, :, None, None] * offsets[..., None, :]).sum(-1)
        size = offsets.new_tensor([shape[1], shape[0]])
        return reference[:, :, None, None, :2] + turned / size


@MODELS.register_module()
class GaussianDecoderLayer(MapDecoderLayer):
    """MapTR's layer guided by Gaussians; to guide another one, inherit from both, this one first.

    Both parts start neutral: the offsets' frame is the identity and the embedding zero, so a layer
    with the weights of a MapTR layer computes what that layer computes.

    Args:
        space: How the reference stands for a Gaussian.
        guide_sampling: Sample the BEV features in each Gaussian's own frame.
        embed_gaussians: Add an embedding of (mu, sigma, theta) to the query's position.
        embed_hidden_dims: Hidden channels of that embedding.
        embed_dims: Channels C.
        kwargs: Settings of the layer.
    """

    neutral_keys = ("gaussian_embedding.",)

    def __init__(
        self,
        space: GaussianSpace,
        guide_sampling: bool = True,
        embed_gaussians: bool = True,
        embed_hidden_dims: int = 16,
        embed_dims: int = 256,
        **kwargs: Any,
    ) -> None:
        self._attention_space = space if guide_sampling else None
        super().__init__(embed_dims=embed_dims, **kwargs)
        self.space = space
        self.gaussian_embedding: nn.Sequential | None = None
        if embed_gaussians:
            self.gaussian_embedding = nn.Sequential(
                nn.Linear(6, embed_hidden_dims),
                nn.ReLU(True),
                nn.Linear(embed_hidden_dims, embed_dims),
            )

    def build_cross_attention(
        self, embed_dims: int, num_heads: int, num_sampling_points: int, dropout: float
    ) -> DeformableAttention:
        """Return the attention that `sample_bev` uses."""
        if self._attention_space is None:
            return super().build_cross_attention(
                embed_dims, num_heads, num_sampling_points, dropout
            )
        return GaussianDeformableAttention(
            self._attention_space, embed_dims, num_heads, num_sampling_points, dropout=dropout
        )

    def init_weights(self) -> None:
        """Initialise as the layer does; the embedding's last matrix starts at zero."""
        super().init_weights()
        self.reset_gaussian_parts()

    def reset_gaussian_parts(self) -> None:
        """Make what GSMap adds neutral."""
        if self.gaussian_embedding is not None:
            constant_init(self.gaussian_embedding[-1], 0.0)

    def embed_position(self, query_pos: Tensor, reference: Tensor) -> Tensor:
        """Add the embedded Gaussians to the queries' learned position. (B, N * P, C)"""
        position = super().embed_position(query_pos, reference)
        if self.gaussian_embedding is None:
            return position
        return position + self.gaussian_embedding(self.space.describe(reference))
