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

# Layer that predicts sampling heights, as a pair of key prefixes: in the release, and here. Only
# MapQR has it, so it identifies the architecture. ``{i}`` in a prefix stands for a number.
_HEIGHTS = (
    ENCODER_LAYER + "attentions.1.height_offsets.",
    OUR_ENCODER_LAYER + "cross_attn.height_offsets.",
)
MAPQR = KeyMap(
    "mapqr",
    # Rules, each a pair of key prefixes. The first rule that matches a key renames it.
    (
        _HEIGHTS,  # before the rule of MAPTR for all of ``cross_attn.``
        *MAPTR.rules,
        *MASK_RULES,  # auxiliary segmentation heads
        (DECODER + "pt_pos_query_projs.{i}.", LAYER + "position_proj."),
    ),
    # Keys of the release without a counterpart here.
    unused={**CODE_WEIGHTS, **MASK_WEIGHTS},
    markers=(_HEIGHTS,),
    # Further such keys. A conversion to the format of the release does not write them.
    ignored_pattern=GRID_OFFSETS,
)

KEY_MAPS = (MAPQR,)  # read by `gsmap.checkpoints.key_map`
