"""Mapping between the state keys of the released HDMapNet and of this project.

`rules_of` takes the common prefix of released keys, the common prefix of the keys here, and a text.
Each word of the text continues both prefixes: ``released=here``, or one name for both. ``{i}``
stands for a number. `zeros` lists keys of the release that have no effect there and no counterpart
here. Conversion to the release writes zeros of the listed shapes under these keys.
"""

from gsmap.checkpoints.efficientnet_keys import (
    efficientnet_rules,
    norm_shapes,
    unused_classifier,
)
from gsmap.checkpoints.key_rules import KeyMap, rules_of, zeros

_TRUNK = "camencode.trunk."
_BEV = "bevencode."
_OURS = "map_head.decoder."
_VIEWS = "view_fusion.hw_mat."


HDMAPNET = KeyMap(
    "hdmapnet",
    (
        *efficientnet_rules(_TRUNK, "img_backbone."),  # the keys of the EfficientNet-B0
        ("camencode.up1.conv.", "img_neck.joined."),
        (f"{_VIEWS}{{i}}.", "bev_encoder.views.{i}."),  # {{i}} is {i} in an f-string
        *rules_of(
            _BEV,
            _OURS,
            "conv1.=stem.0. bn1.=stem.1. layer1.=stages.0. layer2.=stages.1. layer3.=stages.2. "
            "up1.conv.=joined.0. up1_embedded.conv.=joined.1. up2.1.=maps.0.0. up2.2.=maps.0.1. "
            "up2.4.=maps.0.3. up2_embedded.1.=maps.1.0. up2_embedded.2.=maps.1.1. "
            "up2_embedded.4.=maps.1.3. up2_direction.1.=maps.2.0. up2_direction.2.=maps.2.1. "
            "up2_direction.4.=maps.2.3.",
        ),
    ),
    unused={
        **unused_classifier(_TRUNK),  # the classifier of the EfficientNet-B0
        # The release has a first block for the directions, but never calls it and uses the block of
        # the embeddings instead. Conversion to the release writes zeros of these shapes.
        **zeros(
            f"{_BEV}up1_direction.conv.",
            {
                "0.weight": (256, 320, 3, 3),
                **norm_shapes("1.", 256),
                "3.weight": (256, 256, 3, 3),
                **norm_shapes("4.", 256),
            },
        ),
    },
    # Key prefixes (release, here) by which a checkpoint of this model is recognised. Keys with the
    # prefix `_VIEWS` occur in the release only.
    markers=((_VIEWS, "bev_encoder.views."),),
    upstream_prefix=_VIEWS,
)

KEY_MAPS = (HDMAPNET,)
