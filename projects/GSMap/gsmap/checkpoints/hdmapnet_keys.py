"""The table between the state keys of HDMapNet's release and ours."""

from itertools import accumulate

from gsmap.checkpoints.key_rules import KeyMap, Rules, rules_of, zeros

_TRUNK = "camencode.trunk."
_BEV = "bevencode."
_OURS = "map_head.decoder."
VIEWS = "view_fusion.hw_mat."
_STAGES = (1, 2, 2, 6, 5)  # blocks of each of our backbone's stages; the release counts through
_LEAVES = ("weight", "bias", "running_mean", "running_var")


def _block_rules() -> Rules:
    """Return the rules of the image backbone's blocks."""
    rules: Rules = ()
    for stage, (number, end) in enumerate(zip(_STAGES, accumulate(_STAGES), strict=True), 1):
        for block in range(number):
            rules += rules_of(
                f"{_TRUNK}_blocks.{end - number + block}._",
                f"img_backbone.layers.{stage}.{block}.",
                "expand_conv.=expand_conv.conv. bn0.=expand_conv.bn. "
                "depthwise_conv.=depthwise_conv.conv. bn1.=depthwise_conv.bn. "
                "se_reduce.=se.conv1.conv. se_expand.=se.conv2.conv. "
                "project_conv.=linear_conv.conv. bn2.=linear_conv.bn.",
            )
    return rules


def _norm(prefix: str, channels: int) -> dict[str, tuple[int, ...]]:
    """Return the shapes of a batch normalisation."""
    return {**{prefix + leaf: (channels,) for leaf in _LEAVES}, f"{prefix}num_batches_tracked": ()}


HDMAPNET = KeyMap(
    "hdmapnet",
    (
        *_block_rules(),
        *rules_of(_TRUNK, "img_backbone.layers.0.", "_conv_stem.=conv. _bn0.=bn."),
        ("camencode.up1.conv.", "img_neck.joined."),
        (f"{VIEWS}{{i}}.", "bev_encoder.views.{i}."),
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
    {
        # the trunk's classifier, which no map needs
        **zeros(
            _TRUNK,
            {
                "_conv_head.weight": (1280, 320, 1, 1),
                **_norm("_bn1.", 1280),
                "_fc.weight": (1000, 1280),
                "_fc.bias": (1000,),
            },
        ),
        # the directions' own first block: they take that of the embeddings
        **zeros(
            f"{_BEV}up1_direction.conv.",
            {
                "0.weight": (256, 320, 3, 3),
                **_norm("1.", 256),
                "3.weight": (256, 256, 3, 3),
                **_norm("4.", 256),
            },
        ),
    },
    markers=((VIEWS, "bev_encoder.views."),),
)
