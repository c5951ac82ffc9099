"""The base class of losses of matched pairs."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from gsmap.models.base.pairs import BuiltHead, MatchedPairs
from gsmap.models.base.parts import WEIGHT, class_weights
from gsmap.utils.errors import InputTypeError
from gsmap.utils.targets import NeedsTargets


class MapLoss(nn.Module, NeedsTargets):
    """A loss of matched pairs: the weighted sum of its `values` over the number of pairs.

    The pairs are of all decoder layers at once.

    Args:
        loss_weight: Weight of the loss, or one for each class; a pair has that of its ground truth.
        last_layer_only: Leave it out of all decoder layers but the last.
        first_group_only: Leave it out of all query groups but the one that predicts.

    Attributes:
        name: It is logged as ``loss_<name>``; unique in a head.

    Raises:
        TypeError: If a class sets a flag as its attribute, where a misspelt one would be silent, or
            a loss that is no sum over pairs has a weight for each class.
    """

    name: str
    loss_weight: Any

    def __init__(
        self,
        loss_weight: WEIGHT = 1.0,
        last_layer_only: bool = False,
        first_group_only: bool = False,
    ) -> None:
        super().__init__()
        own = {name: getattr(type(self), name) for name in ("forward", "by_layer")}
        is_sum = own == {name: getattr(MapLoss, name) for name in own}
        if isinstance(loss_weight, Sequence) and not is_sum:
            raise InputTypeError(
                f"{type(self).__name__} is no sum over pairs: give one loss_weight."
            )
        self.loss_weight = loss_weight
        self.last_layer_only, self.first_group_only = last_layer_only, first_group_only

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        flags = [name for name, value in vars(cls).items() if isinstance(value, bool)]
        if flags:
            raise InputTypeError(
                f"{cls.__name__} sets {flags} as attributes of the class: pass last_layer_only and "
                "first_group_only to MapLoss.__init__."
            )

    def check(self, head: BuiltHead) -> None:
        """Raise ValueError if a head lacks what the loss reads; called when the head is built."""

    def reads(self, pairs: MatchedPairs) -> bool:
        """Return whether a layer has what the loss reads."""
        return True

    def values(self, pairs: MatchedPairs) -> Tensor:
        """Return the values that are summed, of each pair. (M, ...)"""
        raise NotImplementedError

    def forward(self, pairs: MatchedPairs) -> Tensor:
        """Return the weighted loss of one layer, 0 with a gradient of 0 without pairs. ()"""
        (loss,) = self.by_layer(pairs)
        return loss

    def by_layer(self, pairs: MatchedPairs) -> Tensor:
        """Return the weighted loss of each layer. (L,)

        A loss that overrides `forward` is called with the pairs of one layer after another.
        """
        if type(self).forward is not MapLoss.forward:
            return torch.stack([self(pairs.layer(number)) for number in range(pairs.num_layers)])
        values = self.values(pairs)
        if isinstance(self.loss_weight, Sequence):
            weights = class_weights(self.loss_weight, pairs.gt_labels)
            values = (weights * values.movedim(0, -1)).movedim(-1, 0)
        sums = pairs.by_layer(values).flatten(1).sum(1) / pairs.avg_factor
        return sums if isinstance(self.loss_weight, Sequence) else self.loss_weight * sums
