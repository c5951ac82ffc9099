"""The decoder layer that Gaussians guide (GSMap section 3.4)."""

from typing import Any

from mmdet3d.registry import MODELS

from gsmap.models.base.decoder import MapDecoder, MapDecoderLayer
from gsmap.models.base.parts import PARTS, class_of
from gsmap.models.gsmap.guidance import GaussianGuidance


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
        guidance = {
            "type": GaussianGuidance,
            "sampling": guide_sampling,
            "embedding": embed_gaussians,
            "invariant": invariant_frame,
            "hidden_dims": embed_hidden_dims,
        }
        super().__init__(guidance=guidance, **kwargs)


def add_guidance(decoder: PARTS) -> PARTS:
    """Return a decoder's config with layers that Gaussians guide, where it says nothing else."""
    kind, layer = class_of({"type": MapDecoder, **decoder}), decoder.get("layer", {})
    if kind is None or not issubclass(kind, MapDecoder) or kind.layer_class is MapDecoderLayer:
        return {**decoder, "layer": {"type": GaussianDecoderLayer, **layer}}
    guidance = layer.get("guidance", {})
    if guidance is not None:
        guidance = {"type": GaussianGuidance, **guidance}
    return {**decoder, "layer": {**layer, "guidance": guidance}}
