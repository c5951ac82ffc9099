"""GeMap's head: instances and points attend apart, shapes and relations are supervised."""

from collections.abc import Sequence
from typing import Any

from mmdet3d.registry import MODELS

from gsmap.models.maptr.head import PARTS, MapHead
from gsmap.models.maptr.parts import switched

ATTENTION = "GeometryDecoupledAttention"


@MODELS.register_module()
class GeMapHead(MapHead):
    """The map head with GeMap's parts as defaults, on whatever else it is made of.

    On a MapTR config this is GeMap with its simple objective, on MapTRv2 with its full one.
    Besides `MapHead`'s arguments:

    Args:
        loss_euclidean: Settings of `EuclideanLoss`, or None to train without it.
        decoupled: Let the layers' self-attention be GeMap's; else it is the config's.
        one_to_many: Keep the further query groups, which GeMap does not have. The Euclidean loss of
            many matches takes much memory: name the losses of such a group.
    """

    def __init__(
        self,
        decoder: PARTS,
        losses: Sequence[PARTS],
        query_groups: Sequence[PARTS] = ({"num": 50},),
        loss_euclidean: PARTS | None = {"loss_weight": 0.005},  # noqa: B006
        decoupled: bool = True,
        one_to_many: bool = False,
        **kwargs: Any,
    ) -> None:
        layer = decoder.get("layer", {})
        if decoupled and layer.get("self_attn", {}).get("type") != ATTENTION:
            decoder = {**decoder, "layer": {**layer, "self_attn": {"type": ATTENTION}}}
        super().__init__(
            decoder=decoder,
            losses=[*losses, *switched("EuclideanLoss", loss_euclidean)],
            query_groups=query_groups if one_to_many else query_groups[:1],
            **kwargs,
        )
