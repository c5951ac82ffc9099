"""State keys of the released HRMapNet, which is based on MapTRv2, and their names here.

The first two arguments of `rules_of` are the prefixes of keys in the release and here. Each word of
the text continues both prefixes, as ``released=here`` or as one name that both have. ``{i}`` stands
for a number, which both keys have.
"""

from gsmap.checkpoints.key_rules import KeyMap, rules_of
from gsmap.models.maptr.keys import HEAD, TRANSFORMER
from gsmap.models.maptrv2.keys import LIFTED_MARKER, LIFTED_UNUSED, MAPTRV2

_BEV_LAYER = "prior.bev.layer."  # prefix here of the BEV layer that fuses the map
# Prefix of a transformer layer of this BEV layer in the release.
_MAP_LAYER = TRANSFORMER + "map_encoder.layers.{i}."
# Prefixes of the label encoder, released and here.
_LABEL_ENCODER = (HEAD + "label_encoder.", "prior.queries.label_encoder.")
# Modules that the released MapTRv2 has but never calls. HRMapNet calls them in its BEV layer, so
# they are not among its unused keys.
_USED_AGAIN = ("positional_encoding.", "transformer.level_embeds", "transformer.cams_embeds")
_UNUSED = {
    key: value
    for key, value in LIFTED_UNUSED.items()
    if not key.removeprefix(HEAD).startswith(_USED_AGAIN)
}

HRMAPNET = KeyMap(
    "hrmapnet",
    (
        *MAPTRV2.rules,
        _LABEL_ENCODER,
        *rules_of(HEAD, "prior.queries.", "query_attention.attn.=attention."),
        *rules_of(TRANSFORMER, "prior.bev.", "map_feats_conv.=conv."),
        *rules_of(HEAD, _BEV_LAYER, "bev_embedding. positional_encoding."),
        *rules_of(TRANSFORMER, _BEV_LAYER, "level_embeds cams_embeds"),
        *rules_of(
            _MAP_LAYER,
            _BEV_LAYER + "layers.{i}.",
            "attentions.0.=self_attn. attentions.1.output_proj.=cross_attn.output_proj. "
            "attentions.1.deformable_attention.=cross_attn. ffns.0.=ffn. norms.",
        ),
    ),
    unused=_UNUSED,
    # A checkpoint is recognised as HRMapNet's if it has keys of both parts: the encoder that lifts
    # features by their predicted depth, and the label encoder.
    markers=(LIFTED_MARKER, _LABEL_ENCODER),
)

KEY_MAPS = (HRMAPNET,)  # read by `gsmap.checkpoints.key_map`
