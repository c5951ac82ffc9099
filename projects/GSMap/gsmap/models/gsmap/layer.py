"""The decoder layer that Gaussians guide (GSMap section 3.4)."""

from typing import Any

from mmdet3d.registry import MODELS

from gsmap.models.maptr.decoder import MapDecoderLayer


@MODELS.register_module()
class GaussianDecoderLayer(MapDecoderLayer):
    """The layer guided by Gaussians (GSMap section 3.4), whatever its attentions are.

    Args:
        guide_sampling: Sample the BEV features in each Gaussian's own frame.
        embed_gaussians: Add an embedding of (mu, sigma, theta) to the query's position.
        invariant_frame: Take the sampling frame that is the same for theta and theta + pi.
        embed_hidden_dims: Hidden channels of that embedding.
        kwargs: Arguments of `MapDecoderLayer`.
    """

    def __init__(
        self,
        guide_sampling: bool = True,
        embed_gaussians: bool = True,
        invariant_frame: bool = False,
        embed_hidden_dims: int = 16,
        **kwargs: Any,
    ) -> None:
        guidance: dict[str, Any] = {"sampling": guide_sampling, "embedding": embed_gaussians}
        guidance |= {"invariant": invariant_frame, "hidden_dims": embed_hidden_dims}
        super().__init__(guidance=guidance, **kwargs)
