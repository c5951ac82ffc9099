"""Rules for the state keys that the released heads of lines with masks have in common.

The rules pair these keys with the keys of this project. `rules_of` takes a prefix of the released
keys, a prefix of the keys here, and the remainders of the keys as one text: each is
``released=here``, or a single name if both are equal. ``{i}`` stands for the number of a layer or
branch, which is equal on both sides.
"""

import torch

from gsmap.checkpoints.key_rules import Rules, rules_of

LINE_DECODER = "ins_decoder.bev_decoder."
"""Key prefix of these two released models, which no key of this project has."""

BEV = "bev_decoder.bev_encoder."
"""Key prefix of the released BEV encoder."""
# Names of the two layers of a feed-forward network, to be inserted into a text of `rules_of`.
LINEAR = "linear1.=ffn.layers.0.0. linear2.=ffn.layers.1. "
# Index of each linear layer of an MLP: in the release, and here, where activations are counted.
_MLP = ((0, 0), (1, 2), (2, 4))


def mlps(theirs: str, ours: str) -> Rules:
    """Rules of the keys of an MLP.

    Args:
        theirs: Prefix of its keys in the release.
        ours: Prefix of its keys here.
    """
    rules = []
    for released_index, our_index in _MLP:
        rules.append((f"{theirs}layers.{released_index}.", f"{ours}{our_index}."))
    return tuple(rules)


LINE_DECODER_RULES = (
    *rules_of(
        LINE_DECODER + "transformer_",
        "map_head.decoder.layers.{i}.",
        "cross_attention_layers.{i}.multihead_attn.=cross_attn. "
        "cross_attention_layers.{i}.norm.=norms.0. "
        "self_attention_layers.{i}.self_attn.=self_attn. "
        "self_attention_layers.{i}.norm.=norms.1. "
        "ffn_layers.{i}.linear1.=ffn.layers.0.0. ffn_layers.{i}.linear2.=ffn.layers.1. "
        "ffn_layers.{i}.norm.=norms.2.",
    ),
    *rules_of(
        LINE_DECODER,
        "map_head.decoder.",
        "level_embed.=level. decoder_norm.=norm.",
    ),
)
HEAD_RULES = (
    *mlps("output_head.coords_head.", "map_head.coordinates."),
    ("output_head.semantic_heads.{i}.0.", "map_head.semantic_branches.{i}."),
)
# The released models store the weights of their class loss as a buffer: 1.0 for elements, and 0.5
# for queries without an element. Here they are a setting of the loss. Conversion from the release
# drops the key, and conversion to the release writes this value.
CLASS_WEIGHTS = {"post_processor.criterion.empty_weight": torch.tensor((1.0, 0.5))}
