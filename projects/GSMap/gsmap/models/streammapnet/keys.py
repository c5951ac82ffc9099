"""Mapping between the state keys of the released StreamMapNet and of this project.

`rules_of` takes the common prefix of released keys, the common prefix of the keys here, and a text.
Each word of the text continues both prefixes: ``released=here``, or one name for both. A rule
replaces the beginning of a key, so most names end with a dot. ``{i}`` stands for the index of a
layer. The first rule that matches a key is applied.
"""

import torch

from gsmap.checkpoints.key_rules import KeyMap, rules_of
from gsmap.models.maptr.keys import LAYER, OUR_ENCODER_LAYER

_BACKBONE = "backbone."
_INPUT = "head.input_proj."
_ENCODER = "backbone.transformer.encoder.layers.{i}."
_DECODER = "head.transformer.decoder.layers.{i}."
# Coordinates of the 50 x 100 cells of the released map, in metres; row 0 has the largest y.
_Y, _X = torch.meshgrid(
    torch.linspace(15.0, -15.0, 50), torch.linspace(-30.0, 30.0, 100), indexing="ij"
)
STREAMMAPNET = KeyMap(
    "streammapnet",
    (
        *rules_of(_BACKBONE, "", "img_backbone. img_neck."),
        *rules_of(_BACKBONE, "bev_encoder.", "bev_embedding. positional_encoding."),
        *rules_of(_BACKBONE + "transformer.", "bev_encoder.", "level_embeds cams_embeds"),
        *rules_of(
            _ENCODER,
            OUR_ENCODER_LAYER,
            "attentions.0.=self_attn. attentions.1.output_proj.=cross_attn.output_proj. "
            "attentions.1.deformable_attention.=cross_attn. ffns.0.=ffn. norms.",
        ),
        *rules_of("head.", "map_head.", "query_embedding.=instance_embedding. cls_branches."),
        *rules_of("head.", "map_head.reference.", "reference_points_embed.=initial."),
        *rules_of("head.", "map_head.reference.", "reg_branches.=branches."),
        (_INPUT, "map_head.decoder.input_proj."),
        *rules_of(
            _DECODER,
            LAYER,
            "attentions.0.attn.=self_attn. attentions.1.=cross_attn. ffns.0.=ffn. norms.",
        ),
        ("head.query_update.fc.", "temporal.queries.fc."),
        ("stream_fusion_neck.", "temporal.bev."),
    ),
    # Released keys without a counterpart here, because the cells, the size and the corner of the
    # map are settings of a config. A conversion to the released format writes these values.
    unused={
        # Homogeneous coordinates (x, y, 0, 1) of the cells. (50, 100, 4)
        "plane": torch.stack([_X, _Y, torch.zeros_like(_X), torch.ones_like(_X)], -1),
        "head.roi_size": torch.tensor((60.0, 30.0)),
        "head.origin": torch.tensor((-30.0, -15.0)),
    },
    # `markers` distinguish this architecture from others, in the release and here. Only released
    # keys have `upstream_prefix`.
    markers=((_INPUT, "map_head.decoder.input_proj."),),
    upstream_prefix=_INPUT,
)

KEY_MAPS = (STREAMMAPNET,)  # read by `gsmap.checkpoints.key_map`
