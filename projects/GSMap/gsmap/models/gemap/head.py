"""Head of GeMap: decoupled self-attention, and a loss of shapes and relations."""

from collections.abc import Mapping, Sequence
from typing import Any

from mmdet3d.registry import MODELS

from gsmap.models.base.head import MapHead
from gsmap.models.base.parts import DEFAULTS, PartConfig, class_of, optional_part
from gsmap.models.gemap.attention import GeometryDecoupledAttention
from gsmap.models.gemap.losses import EuclideanLoss


@MODELS.register_module()
class GeMapHead(MapHead):
    """Map head with the modules of GeMap as defaults.

    In a MapTR config this head makes GeMap with its simple objective, and in a MapTRv2 config GeMap
    with its full objective.

    Args:
        decoder: Config of the decoder; its self-attention is replaced if ``decoupled``.
        losses: Configs of the other losses.
        query_groups: Settings of each `QueryGroup`. Without ``one_to_many``, only the first group
            is used.
        loss_euclidean: Settings of `EuclideanLoss`. The default ``DEFAULTS`` is empty and leaves
            all settings at their default values. None trains the head without this loss.
        decoupled: Whether to use the self-attention of GeMap in the layers instead of the
            configured one.
        one_to_many: Whether to keep the query groups after the first one, which GeMap does not
            have. The Euclidean loss of their many matches takes much memory. To train a group
            without this loss, list the names of the other losses in ``losses`` of its
            `QueryGroup`.
        kwargs: Further arguments of `MapHead`.
    """

    def __init__(
        self,
        decoder: PartConfig,
        losses: Sequence[PartConfig],
        query_groups: Sequence[PartConfig] = ({"num": 50},),
        loss_euclidean: Mapping[str, Any] | None = DEFAULTS,
        decoupled: bool = True,
        one_to_many: bool = False,
        **kwargs: Any,
    ) -> None:
        layer = decoder.get("layer", {})
        # An attention of this class in the config is kept, because it may have other settings.
        attention_class = class_of(layer.get("self_attn", {}))
        if decoupled and attention_class is not GeometryDecoupledAttention:
            layer = {**layer, "self_attn": {"type": GeometryDecoupledAttention}}
            decoder = {**decoder, "layer": layer}
        # `optional_part` returns a list with one config, or an empty list for None.
        super().__init__(
            decoder=decoder,
            losses=[*losses, *optional_part(EuclideanLoss, loss_euclidean)],
            query_groups=query_groups if one_to_many else query_groups[:1],
            **kwargs,
        )
