"""MGMapNet's head: instance and point queries, masks of the instances, supervised samples."""

import logging
from collections.abc import Mapping, Sequence
from typing import Any

from mmdet3d.registry import MODELS
from mmengine.logging import print_log

from gsmap.models.base.attention import BEVDeformableAttention
from gsmap.models.base.head import MapHead
from gsmap.models.base.masks import ElementMasks
from gsmap.models.base.parts import DEFAULTS, PARTS, brought, class_of
from gsmap.models.maptrv2.attention import DecoupledSelfAttention
from gsmap.models.mgmapnet.decoder import MGMapNetDecoder, MGMapNetDecoderLayer
from gsmap.models.mgmapnet.losses import InstanceMaskLoss, SamplingLocationLoss
from gsmap.structures.grid import BEVGrid

LINE_PX = 3
QUERY_GROUPS: tuple[PARTS, ...] = ({"num": 100}, {"name": "one2many", "num": 600, "repeats": 6})


@MODELS.register_module()
class MGMapHead(MapHead):
    """The map head with MGMapNet's parts as defaults. Besides `MapHead`'s arguments:

    Args:
        decoder: Config of the decoder; one of another class becomes `MGMapNetDecoder` (see
            `with_granularities`).
        loss_mean_loc: Settings of `SamplingLocationLoss`, or None to train without it.
        loss_ins_seg: Settings of `InstanceMaskLoss`, or None to train without it.
        masks: Settings of `ElementMasks`; its lines are 3 pixels wide by default.
    """

    def __init__(
        self,
        grid: BEVGrid,
        decoder: PARTS,
        losses: Sequence[PARTS],
        query_groups: Sequence[PARTS] = QUERY_GROUPS,
        loss_mean_loc: Mapping[str, Any] | None = DEFAULTS,
        loss_ins_seg: Mapping[str, Any] | None = DEFAULTS,
        masks: PARTS | None = None,
        embed_dims: int = 256,
        **kwargs: Any,
    ) -> None:
        drawing = ElementMasks(grid, **(masks or {}))
        if "line_width_m" not in (masks or {}):
            drawing.line_width_m = LINE_PX * 2 * drawing.half_pixel_m
        mean_loc = brought(SamplingLocationLoss, loss_mean_loc)
        ins_seg = brought(InstanceMaskLoss, loss_ins_seg, embed_dims=embed_dims)
        super().__init__(
            grid=grid,
            decoder=with_granularities(decoder),
            losses=[*losses, *mean_loc, *ins_seg],
            query_groups=query_groups,
            masks=drawing,
            embed_dims=embed_dims,
            **kwargs,
        )


def with_granularities(decoder: PARTS) -> PARTS:
    """Return a decoder's config as one of `MGMapNetDecoder`, which takes queries of instances.

    What MapTR's and MapTRv2's configs say of their own layers and attentions, which take queries of
    points, is replaced, and a line in the log names it. Any other attention reaches the layer.
    """
    kind = class_of(decoder)
    if kind is not None and issubclass(kind, MGMapNetDecoder):
        return decoder
    layer = dict(decoder.get("layer", {}))
    replaced = {}
    kind = class_of(layer)
    if kind is None or not issubclass(kind, MGMapNetDecoderLayer):
        replaced["type"] = layer.pop("type", None)
    if class_of(layer.get("self_attn") or {}) is DecoupledSelfAttention:
        replaced["self_attn"] = layer.pop("self_attn")
    cross_attn = layer.get("cross_attn") or {}
    if class_of(cross_attn) in (None, BEVDeformableAttention):
        replaced["cross_attn"] = layer.pop("cross_attn", None)
    named = {name: part for name, part in replaced.items() if part}
    if named:
        print_log(f"MGMapHead replaces {named} of its decoder's layers.", "current", logging.INFO)
    return {**decoder, "type": MGMapNetDecoder, "layer": layer}
