"""MGMapNet's head: instance and point queries, masks of the instances, supervised samples."""

from collections.abc import Sequence
from typing import Any

from mmdet3d.registry import MODELS

from gsmap.models.maptr.head import PARTS, MapHead
from gsmap.models.maptr.masks import ElementMasks
from gsmap.models.maptr.parts import switched
from gsmap.structures.grid import BEVGrid

DECODER = "MGMapNetDecoder"
LINE_PX = 3
QUERY_GROUPS: tuple[PARTS, ...] = ({"num": 100}, {"name": "one2many", "num": 600, "repeats": 6})


@MODELS.register_module()
class MGMapHead(MapHead):
    """The map head with MGMapNet's parts as defaults. Besides `MapHead`'s arguments:

    Args:
        decoder: Config of the decoder; one of another type becomes `MGMapNetDecoder`, its layers
            without the attentions that are not MGMapNet's.
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
        loss_mean_loc: PARTS | None = {"loss_weight": 5.0},  # noqa: B006
        loss_ins_seg: PARTS | None = {"loss_weight": 3.0, "dice_weight": 3.0},  # noqa: B006
        masks: PARTS | None = None,
        embed_dims: int = 256,
        **kwargs: Any,
    ) -> None:
        if decoder.get("type") != DECODER:  # another's attentions go
            others = ("type", "self_attn", "cross_attn")
            layer = {k: v for k, v in decoder.get("layer", {}).items() if k not in others}
            decoder = {**decoder, "type": DECODER, "layer": layer}
        mean_loc = switched("SamplingLocationLoss", loss_mean_loc)
        ins_seg = switched("InstanceMaskLoss", loss_ins_seg, embed_dims=embed_dims)
        pixel_m = max(ElementMasks(grid, **(masks or {})).grid.pixel_size_m)
        super().__init__(
            grid=grid,
            decoder=decoder,
            losses=[*losses, *mean_loc, *ins_seg],
            query_groups=query_groups,
            masks={"line_width_m": LINE_PX * pixel_m, **(masks or {})},
            embed_dims=embed_dims,
            **kwargs,
        )
