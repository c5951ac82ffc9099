"""Mapping between the state keys of the released GeMap and of this project.

`rules_of` takes the common prefix of released keys, the common prefix of the keys here, and a text.
Each word of the text continues both prefixes: ``released=here``, or one name for both. In a
`KeyMap`, the first rule that matches a key is applied. ``unused`` are released keys without a
counterpart here, with the values that conversion to the release writes. None marks a key that only
some checkpoints have and that conversion does not write. If all ``markers`` are present, the keys
are of this model.
"""

import torch

from gsmap.checkpoints.key_rules import KeyMap, rules_of
from gsmap.models.maptr.keys import (
    CODE_WEIGHTS,
    DECODER_LAYER,
    DECODER_RULES,
    GRID_OFFSETS,
    HEAD,
    LAYER,
    MAPTR,
)
from gsmap.models.maptrv2.keys import LIFTED_MARKER, LIFTED_RULES, LIFTED_UNUSED

# The names have the meaning of releases since 2023-12-12. Before that date, "intra" was the
# attention between instances and "inter" the attention within each instance. The keys do not show
# which version a checkpoint has.
_GEOMETRY_RULES = rules_of(
    DECODER_LAYER + "attentions.0.", LAYER + "self_attn.", "inter_=inter. intra_=intra."
)
# Simple objective: GeMap in MapTR.
GEMAP = KeyMap(
    "gemap",
    (*_GEOMETRY_RULES, *MAPTR.rules),
    unused={
        **CODE_WEIGHTS,
        # Buffers of the full objective. The released model of Argoverse 2 also has them. Its simple
        # objective is the full objective with zero weights for the additional losses.
        HEAD + "tau": None,  # not used in any computation
        HEAD + "loss_seg.loss_fn.pos_weight": None,
        HEAD + "loss_pv_seg.loss_fn.pos_weight": None,
    },
    markers=_GEOMETRY_RULES[:1],
    ignored_pattern=GRID_OFFSETS,
)
# Full objective: GeMap in MapTRv2, with its encoder that lifts image features by depth. The marker
# of this encoder is an additional condition.
GEMAP_FULL = KeyMap(
    "gemap-full",
    (*_GEOMETRY_RULES, *LIFTED_RULES, *DECODER_RULES),
    unused={**LIFTED_UNUSED, HEAD + "tau": torch.full((1,), 0.1)},
    markers=(*_GEOMETRY_RULES[:1], LIFTED_MARKER),
)

# The map with more markers is first, because keys of the full objective have the marker of both.
KEY_MAPS = (GEMAP_FULL, GEMAP)
