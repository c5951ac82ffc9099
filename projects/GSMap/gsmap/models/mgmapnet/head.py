"""MGMapNet's head: instance and point queries, with losses of masks and sampling locations."""

import logging
from collections.abc import Mapping, Sequence
from typing import Any

from mmdet3d.registry import MODELS
from mmengine.logging import print_log

from gsmap.models.base.attention import BEVDeformableAttention
from gsmap.models.base.head import MapHead
from gsmap.models.base.masks import ElementMasks
from gsmap.models.base.parts import DEFAULTS, PartConfig, class_of, optional_part
from gsmap.models.maptrv2.attention import DecoupledSelfAttention
from gsmap.models.mgmapnet.decoder import MGMapNetDecoder, MGMapNetDecoderLayer
from gsmap.models.mgmapnet.losses import InstanceMaskLoss, SamplingLocationLoss
from gsmap.structures.grid import BEVGrid

LINE_WIDTH_PX = 3
# Groups of instance queries. In the second group, which is used in training only, each ground truth
# is matched with 6 queries.
QUERY_GROUPS: tuple[PartConfig, ...] = (
    {"num": 100},
    {"name": "one2many", "num": 600, "repeats": 6},
)


@MODELS.register_module()
class MGMapHead(MapHead):
    """Map head with MGMapNet's parts as defaults.

    Args:
        grid: Extent of the map, in metres.
        decoder: Settings of the decoder. `convert_decoder` converts settings of a class other
            than `MGMapNetDecoder`.
        losses: Settings of the other losses, to which the two losses below are added.
        query_groups: Settings of the query groups.
        loss_mean_loc: Settings of `SamplingLocationLoss`, or None to train without it.
        loss_ins_seg: Settings of `InstanceMaskLoss`, or None to train without it.
        masks: Settings of `ElementMasks`, whose lines are 3 pixels wide by default.
        embed_dims: Channels C of the queries and of the BEV features.
        kwargs: Further arguments of `MapHead`.
    """

    def __init__(
        self,
        grid: BEVGrid,
        decoder: PartConfig,
        losses: Sequence[PartConfig],
        query_groups: Sequence[PartConfig] = QUERY_GROUPS,
        loss_mean_loc: Mapping[str, Any] | None = DEFAULTS,
        loss_ins_seg: Mapping[str, Any] | None = DEFAULTS,
        masks: PartConfig | None = None,
        embed_dims: int = 256,
        **kwargs: Any,
    ) -> None:
        mask_settings = masks or {}
        element_masks = ElementMasks(grid, **mask_settings)
        # The default width is in pixels, and the size of a pixel is known only after `ElementMasks`
        # is created. Therefore the width is set here and not given as a setting.
        if "line_width_m" not in mask_settings:
            pixel_m = 2 * element_masks.half_pixel_m
            element_masks.line_width_m = LINE_WIDTH_PX * pixel_m
        # Lists of one config, or empty lists if the losses are switched off.
        mean_loc = optional_part(SamplingLocationLoss, loss_mean_loc)
        ins_seg = optional_part(InstanceMaskLoss, loss_ins_seg, embed_dims=embed_dims)
        super().__init__(
            grid=grid,
            decoder=convert_decoder(decoder),
            losses=[*losses, *mean_loc, *ins_seg],
            query_groups=query_groups,
            masks=element_masks,
            embed_dims=embed_dims,
            **kwargs,
        )


def convert_decoder(decoder: PartConfig) -> PartConfig:
    """Convert the settings of a decoder to settings of `MGMapNetDecoder`.

    Settings of `MGMapNetDecoder` or a subclass are returned as they are.

    The layers and attentions in the configs of MapTR and MapTRv2 need one query per point. Their
    settings are left out, so that the defaults of MGMapNet replace them, and a log message names
    them. Other attentions are kept.
    """
    decoder_class = class_of(decoder)
    if decoder_class is not None and issubclass(decoder_class, MGMapNetDecoder):
        return decoder
    layer = dict(decoder.get("layer", {}))  # a copy, from which settings are removed
    replaced_parts = {}  # removed settings by name; None if they were absent
    layer_class = class_of(layer)
    if layer_class is None or not issubclass(layer_class, MGMapNetDecoderLayer):
        replaced_parts["type"] = layer.pop("type", None)
    self_attn = layer.get("self_attn") or {}
    if class_of(self_attn) is DecoupledSelfAttention:
        replaced_parts["self_attn"] = layer.pop("self_attn")
    cross_attn = layer.get("cross_attn") or {}
    # Settings without a type belong to `BEVDeformableAttention`, the default of `MapDecoderLayer`.
    if class_of(cross_attn) in (None, BEVDeformableAttention):
        replaced_parts["cross_attn"] = layer.pop("cross_attn", None)
    # Only settings that the config gives are logged.
    configured_parts = {name: part for name, part in replaced_parts.items() if part}
    if configured_parts:
        text = f"MGMapHead replaces {configured_parts} of its decoder's layers."
        print_log(text, "current", logging.INFO)
    return {**decoder, "type": MGMapNetDecoder, "layer": layer}
