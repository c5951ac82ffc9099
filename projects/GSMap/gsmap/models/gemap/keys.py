"""The table between the state keys of GeMap's release and ours."""

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

# The names are those of upstream since 2023-12-12. Before, upstream called the attention among
# instances "intra" and the one within each "inter", and no key tells the two apart.
_GEOMETRY_RULES = rules_of(
    DECODER_LAYER + "attentions.0.", LAYER + "self_attn.", "inter_=inter. intra_=intra."
)
GEMAP = KeyMap(
    "gemap",
    (*_GEOMETRY_RULES, *MAPTR.rules),
    {
        **CODE_WEIGHTS,
        # On Argoverse 2, the simple objective is the full one's head with its parts switched off.
        HEAD + "tau": None,  # a number that no computation reads
        HEAD + "loss_seg.loss_fn.pos_weight": None,
        HEAD + "loss_pv_seg.loss_fn.pos_weight": None,
    },
    markers=_GEOMETRY_RULES[:1],
    idle=GRID_OFFSETS,
)
GEMAP_FULL = KeyMap(
    "gemap-full",
    (*_GEOMETRY_RULES, *LIFTED_RULES, *DECODER_RULES),
    {**LIFTED_UNUSED, HEAD + "tau": torch.full((1,), 0.1)},
    markers=(*_GEOMETRY_RULES[:1], LIFTED_MARKER),
)

KEY_MAPS = (GEMAP_FULL, GEMAP)
