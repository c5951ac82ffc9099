"""Decoder layer conditioned on Gaussians (GSMap section 3.4)."""

from typing import Any

from mmdet3d.registry import MODELS

from gsmap.models.base.decoder import MapDecoder, MapDecoderLayer
from gsmap.models.base.parts import PartConfig, class_of, with_defaults
from gsmap.models.gsmap.guidance import GaussianGuidance
from gsmap.utils.errors import InputError


@MODELS.register_module()
class GaussianDecoderLayer(MapDecoderLayer):
    """Decoder layer conditioned on the Gaussians of its queries.

    It is a `MapDecoderLayer` whose part ``guidance`` is a `GaussianGuidance` with these settings.

    Args:
        guide_sampling: Whether to transform sampling offsets by the orientation and size of each
            Gaussian.
        embed_gaussians: Whether to add an embedding of (mu, sigma, theta) to the positional
            queries.
        invariant_frame: Whether to transform offsets by matrices that are equal for theta and
            theta + pi.
        embed_hidden_dims: Hidden channels of the embedding.
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


def add_guidance(decoder: PartConfig) -> PartConfig:
    """Copy the config of a decoder, and condition its layers on Gaussians by default.

    Args:
        decoder: Config of a decoder, whose settings take precedence. A layer with the guidance None
            is not conditioned.

    Returns:
        The copy, in which only ``layer`` is changed.

    Raises:
        ValueError: If a decoder with layers of its own is given a `GaussianDecoderLayer`.
    """
    layer = decoder.get("layer", {})
    decoder_class = class_of(with_defaults(decoder, type=MapDecoder))
    has_other_layers = False
    # The class is None for a name that is not registered; building the decoder fails later.
    if decoder_class is not None and issubclass(decoder_class, MapDecoder):
        has_other_layers = decoder_class.layer_class is not MapDecoderLayer
    # By default the layers are of the guided class. If the decoder has a layer class other than
    # `MapDecoderLayer`, its layers keep this class and get the guidance as a part.
    if not has_other_layers and "guidance" not in layer:
        return {**decoder, "layer": with_defaults(layer, type=GaussianDecoderLayer)}
    layer_class = class_of(layer)
    if has_other_layers and layer_class and issubclass(layer_class, GaussianDecoderLayer):
        raise InputError(
            f"the layers of {decoder['type']} are of a class of its own, and are conditioned on "
            f"Gaussians without {layer_class.__name__}: leave decoder.layer.type out."
        )
    guidance = layer.get("guidance", {})
    if guidance is not None:  # None switches the guidance off
        guidance = with_defaults(guidance, type=GaussianGuidance)
    return {**decoder, "layer": {**layer, "guidance": guidance}}
