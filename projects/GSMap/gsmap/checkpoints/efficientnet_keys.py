"""Rules that map the keys of EfficientNet-B0 between ``efficientnet_pytorch`` and mmdet."""

from torch import Tensor

from gsmap.checkpoints.key_rules import Rules, rules_of, zeros

# Number of blocks in each stage of mmdet's backbone. Upstream has no stages: it numbers the blocks
# consecutively.
_BLOCKS_PER_STAGE = (1, 2, 2, 6, 5)
_NORM_PARAMETERS = ("weight", "bias", "running_mean", "running_var")


def efficientnet_rules(theirs: str, ours: str) -> Rules:
    """Rules for the keys of the image backbone.

    Args:
        theirs: Prefix of the keys of ``efficientnet_pytorch``.
        ours: Prefix of the keys of this project.

    Returns:
        Pairs of key prefixes: first the upstream prefix, then the prefix in this project.
    """
    # `rules_of` splits `names` at blanks. Each entry is the upstream name, "=", and the name in
    # this project, without the prefixes.
    rules = rules_of(upstream=theirs, ours=f"{ours}layers.0.", names="_conv_stem.=conv. _bn0.=bn.")
    upstream_block = 0
    for stage, num_blocks in enumerate(_BLOCKS_PER_STAGE, start=1):  # layer 0 is the stem
        for block in range(num_blocks):
            rules += rules_of(
                upstream=f"{theirs}_blocks.{upstream_block}._",
                ours=f"{ours}layers.{stage}.{block}.",
                # Upstream numbers the norms of a block 0, 1 and 2: after the expansion, after the
                # depthwise convolution and after the projection. `se` is squeeze and excitation.
                names=(
                    "expand_conv.=expand_conv.conv. bn0.=expand_conv.bn. "
                    "depthwise_conv.=depthwise_conv.conv. bn1.=depthwise_conv.bn. "
                    "se_reduce.=se.conv1.conv. se_expand.=se.conv2.conv. "
                    "project_conv.=linear_conv.conv. bn2.=linear_conv.bn."
                ),
            )
            upstream_block += 1
    return rules


def norm_shapes(prefix: str, channels: int) -> dict[str, tuple[int, ...]]:
    """Shapes of the parameters and statistics of a batch normalisation layer.

    Args:
        prefix: Prefix of the keys, with its dot.
        channels: Number of channels.

    Returns:
        The shapes by key.
    """
    shapes: dict[str, tuple[int, ...]] = {}
    for parameter in _NORM_PARAMETERS:
        shapes[prefix + parameter] = (channels,)
    shapes[f"{prefix}num_batches_tracked"] = ()
    return shapes


def unused_classifier(theirs: str) -> dict[str, Tensor]:
    """Placeholder weights of the backbone's classifier, which no map model uses.

    Args:
        theirs: Prefix of the keys of ``efficientnet_pytorch``.

    Returns:
        Zeros by upstream key, for states that are converted to upstream's format.
    """
    shapes: dict[str, tuple[int, ...]] = {
        "_conv_head.weight": (1280, 320, 1, 1),
        **norm_shapes("_bn1.", channels=1280),
        "_fc.weight": (1000, 1280),
        "_fc.bias": (1000,),
    }
    return zeros(theirs, shapes=shapes)
