"""State keys of the released MapQR and their counterparts in this project."""

from gsmap.checkpoints.key_rules import KeyMap
from gsmap.models.maptr.keys import (
    CODE_WEIGHTS,
    DECODER,
    ENCODER_LAYER,
    GRID_OFFSETS,
    LAYER,
    MAPTR,
    OUR_ENCODER_LAYER,
)
from gsmap.models.maptrv2.keys import MASK_RULES, MASK_WEIGHTS

# Layer that predicts sampling heights. Only MapQR has it, so it identifies the architecture.
_HEIGHTS = (
    ENCODER_LAYER + "attentions.1.height_offsets.",
    OUR_ENCODER_LAYER + "cross_attn.height_offsets.",
)
MAPQR = KeyMap(
    "mapqr",
    (
        _HEIGHTS,  # before the rule of MAPTR for all of ``cross_attn.``
        *MAPTR.rules,
        *MASK_RULES,
        (DECODER + "pt_pos_query_projs.{i}.", LAYER + "position_proj."),
    ),
    unused={**CODE_WEIGHTS, **MASK_WEIGHTS},
    markers=(_HEIGHTS,),
    ignored_pattern=GRID_OFFSETS,
)

KEY_MAPS = (MAPQR,)
