"""Rules between the keys of the EfficientNet-B0 that releases use and those of mmdet's."""

from itertools import accumulate

from torch import Tensor

from gsmap.checkpoints.key_rules import Rules, rules_of, zeros

_STAGES = (1, 2, 2, 6, 5)  # blocks of each of our backbone's stages; the release counts through
_LEAVES = ("weight", "bias", "running_mean", "running_var")


def efficientnet_rules(theirs: str, ours: str) -> Rules:
    """Return the rules of the image backbone.

    Args:
        theirs: What keys of the package begin with.
        ours: What our keys begin with.
    """
    rules = rules_of(theirs, f"{ours}layers.0.", "_conv_stem.=conv. _bn0.=bn.")
    for stage, (number, end) in enumerate(zip(_STAGES, accumulate(_STAGES), strict=True), 1):
        for block in range(number):
            rules += rules_of(
                f"{theirs}_blocks.{end - number + block}._",
                f"{ours}layers.{stage}.{block}.",
                "expand_conv.=expand_conv.conv. bn0.=expand_conv.bn. "
                "depthwise_conv.=depthwise_conv.conv. bn1.=depthwise_conv.bn. "
                "se_reduce.=se.conv1.conv. se_expand.=se.conv2.conv. "
                "project_conv.=linear_conv.conv. bn2.=linear_conv.bn.",
            )
    return rules


def norm_shapes(prefix: str, channels: int) -> dict[str, tuple[int, ...]]:
    """Return the shapes of a batch normalisation, by key."""
    return {**{prefix + leaf: (channels,) for leaf in _LEAVES}, f"{prefix}num_batches_tracked": ()}


def unused_classifier(theirs: str) -> dict[str, Tensor]:
    """Return the values of the trunk's classifier, which no map needs.

    Args:
        theirs: What keys of the package begin with.
    """
    return zeros(
        theirs,
        {
            "_conv_head.weight": (1280, 320, 1, 1),
            **norm_shapes("_bn1.", 1280),
            "_fc.weight": (1000, 1280),
            "_fc.bias": (1000,),
        },
    )
