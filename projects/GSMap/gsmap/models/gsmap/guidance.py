"""Conditioning of decoder layers on Gaussians (GSMap section 3.4)."""

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
    """Conditioning of a decoder layer on the Gaussians of its queries, for any attention.

    Before training it has no effect, so a layer with the weights of MapTR has the output of MapTR.
    For this, `init_weights` sets the last layer of the embedding to zero. The matrices that
    transform the sampling offsets are identities for the initial Gaussians of a decoder
    (`GaussianSpace.frames`).

    A reference is the vector of D entries that the decoder refines for each query. It encodes the
    Gaussian: the centre mu, the two standard deviations sigma along its axes, and the angle theta
    of its first axis.

    Args:
        space: Encoding of Gaussians in references. References without Gaussians have None, for
            which a ValueError is raised.
        embed_dims: Channels C.
        sampling: Transform the sampling offsets of deformable attention by the orientation and size
            of each Gaussian.
        embedding: Add an embedding of (mu, sigma, theta) to the positional queries.
        invariant: Use matrices of the offsets that are equal for theta and theta + pi, since both
            angles describe one Gaussian.
        hidden_dims: Hidden channels of the embedding.

    Raises:
        ValueError: If the references have no Gaussians.
    """

    # Prefix of the weights that may be missing in a checkpoint, for example in a checkpoint of
    # MapTR. Missing weights keep their initial values, which have no effect.
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
        self.space = space
        self.sampling = sampling
        self.invariant = invariant
        # The input has the six features of a Gaussian from `GaussianSpace.describe`: mu (2), sigma
        # before its activation (2), cosine and sine of 2 theta.
        self.embedding = mlp(6, hidden_dims, embed_dims) if embedding else None
        self.init_weights()

    def init_weights(self) -> None:
        """Initialise the embedding to zero."""
        if self.embedding is not None:
            constant_init(self.embedding[-1], 0.0)

    def position(self, query_pos: Tensor, reference: Tensor) -> Tensor:
        """Add embeddings of the Gaussians to the positional queries.

        Args:
            query_pos: Positional queries. (B, Q, C)
            reference: References. (B, Q, D)

        Returns:
            Positional queries. (B, Q, C)
        """
        if self.embedding is None:
            return query_pos
        return query_pos + self.embedding(self.space.describe(reference))

    def frames(self, reference: Tensor, feats: Tensor) -> Tensor | None:
        """Matrices that turn and stretch sampling offsets with the Gaussian of each query.

        The offsets are given for the initial Gaussian. The matrices transform them by the change of
        orientation and size from the initial Gaussian to the Gaussian of the query.

        Args:
            reference: References. (B, Q, D)
            feats: Feature map that is sampled (B, C, H, W), or several maps. Offsets are in cells
                of the first map.

        Returns:
            Matrices that multiply offsets (x, y) in cells from the left; None without ``sampling``.
            (B, Q, 2, 2)
        """
        if not self.sampling:
            return None
        finest = feats if isinstance(feats, Tensor) else feats[0]
        height, width = finest.shape[-2:]
        # Width and height of a cell in metres. Gaussians are in metres, but offsets are in cells,
        # which need not be square.
        cell_m = self.space.grid.with_size(height, width).pixel_size_m
        return self.space.frames(reference, invariant=self.invariant, cell_m=cell_m)
