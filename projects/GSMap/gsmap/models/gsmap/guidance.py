"""How one layer's Gaussians guide where the next looks (GSMap section 3.4)."""

from mmdet3d.registry import MODELS
from mmengine.model import constant_init
from torch import Tensor

from gsmap.checkpoints.strict import AddsWeights
from gsmap.models.base.decoder import Guidance
from gsmap.models.base.layers import mlp
from gsmap.structures.gaussians import GaussianSpace
from gsmap.utils.errors import InputError


@MODELS.register_module()
class GaussianGuidance(Guidance, AddsWeights):
    """What a decoder layer takes from the Gaussians, for whichever attentions it has.

    Both parts start neutral: the sampling frame is the identity and the embedding zero, so a layer
    with the weights of a MapTR layer computes what that layer computes. The settings are those of
    `GaussianDecoderLayer`.

    Args:
        space: How the reference stands for a Gaussian.
        embed_dims: Channels C.
        sampling: As ``guide_sampling``.
        embedding: As ``embed_gaussians``.
        invariant: As ``invariant_frame``.
        hidden_dims: As ``embed_hidden_dims``.

    Raises:
        ValueError: If the reference holds no Gaussians.
    """

    neutral_keys = ("embedding.",)

    def __init__(
        self,
        space: GaussianSpace | None,
        embed_dims: int,
        sampling: bool = True,
        embedding: bool = True,
        invariant: bool = False,
        hidden_dims: int = 16,
    ) -> None:
        super().__init__()
        if space is None:
            raise InputError("a guided decoder layer needs a reference that holds Gaussians.")
        self.space, self.sampling, self.invariant = space, sampling, invariant
        self.embedding = mlp(6, hidden_dims, embed_dims) if embedding else None
        self.init_weights()

    def init_weights(self) -> None:
        """Make what GSMap adds neutral."""
        if self.embedding is not None:
            constant_init(self.embedding[-1], 0.0)

    def position(self, query_pos: Tensor, reference: Tensor) -> Tensor:
        """Add the embedded Gaussians to the queries' position. (B, Q, C), (B, Q, D) -> (B, Q, C)"""
        if self.embedding is None:
            return query_pos
        return query_pos + self.embedding(self.space.describe(reference))

    def frames(self, reference: Tensor, feats: Tensor) -> Tensor | None:
        """Return what turns sampling offsets in cells into each Gaussian's frame, or None.

        The matrices (B, Q, 2, 2) of references (B, Q, D) multiply offsets (x, y) in cells of the
        sampled map (B, C, H, W) from the left.
        """
        if not self.sampling:
            return None
        finest = feats if isinstance(feats, Tensor) else feats[0]  # of levels
        cell_m = self.space.grid.with_size(*finest.shape[-2:]).pixel_size_m
        return self.space.frames(reference, self.invariant, cell_m)
