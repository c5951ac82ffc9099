"""Base class of losses of matched pairs."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from gsmap.models.base.pairs import BuiltHead, MatchedPairs
from gsmap.models.base.parts import WeightConfig, class_weights
from gsmap.utils.errors import InputError, InputTypeError
from gsmap.utils.targets import NeedsTargets


class MapLoss(nn.Module, NeedsTargets):
    """Loss of matched pairs: the weighted sum of `values`, divided by ``pairs.avg_factor``.

    A pair is a prediction and its ground truth. ``avg_factor`` is the number of pairs of one layer,
    averaged over the processes of a training, and at least 1.

    A subclass overrides one of three methods. A loss that is a sum over pairs overrides `values`;
    the pairs of all decoder layers are then processed at once. Any other loss overrides `forward`,
    which computes one layer, or `by_layer`, which computes all layers at once.

    Args:
        loss_weight: Weight of the loss, or a weight for each class, applied to the pairs whose
            ground truth is of the class.
        last_layer_only: Compute the loss for the last decoder layer only.
        first_group_only: Compute the loss for the first query group only, the only group that is
            used in prediction.

    Attributes:
        name: Name of the loss, unique in a head. It is logged as ``loss_<name>``.

    Raises:
        TypeError: If a loss that is not a sum over pairs has a weight for each class. Also if a
            class attribute of a subclass is a bool. Flags such as ``last_layer_only`` must be
            passed to the constructor instead, because it refuses misspelt names, and a class
            attribute with a misspelt name would be ignored.
    """

    name: str
    loss_weight: Any

    def __init__(
        self,
        loss_weight: WeightConfig = 1.0,
        last_layer_only: bool = False,
        first_group_only: bool = False,
    ) -> None:
        super().__init__()
        kind = type(self)
        # A loss is a sum over pairs if its class overrides neither of these methods.
        is_sum = kind.forward is MapLoss.forward and kind.by_layer is MapLoss.by_layer
        if isinstance(loss_weight, Sequence) and not is_sum:
            raise InputTypeError(f"{kind.__name__} is no sum over pairs: give one loss_weight.")
        self.loss_weight = loss_weight
        self.last_layer_only = last_layer_only
        self.first_group_only = first_group_only

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        flags = [name for name, value in vars(cls).items() if isinstance(value, bool)]
        if flags:
            raise InputTypeError(
                f"{cls.__name__} sets {flags} as attributes of the class: pass last_layer_only and "
                "first_group_only to MapLoss.__init__."
            )

    def check(self, head: BuiltHead) -> None:
        """Raise ValueError if a head lacks an input of the loss. Called when the head is built."""

    def reads(self, pairs: MatchedPairs) -> bool:
        """Whether the predictions of a layer have the inputs of the loss.

        Args:
            pairs: Pairs of the layer.

        Returns:
            False to skip the loss for the layer. By default, the loss is never skipped.
        """
        return True

    def values(self, pairs: MatchedPairs) -> Tensor:
        """Values of each of the M pairs, which `by_layer` sums. (M, ...)"""
        raise NotImplementedError

    def forward(self, pairs: MatchedPairs) -> Tensor:
        """Weighted loss of one layer. Without pairs, it is 0 with a gradient of 0. ()"""
        # This is no endless recursion: `by_layer` calls `forward` only if a subclass overrides it,
        # and then this code does not run.
        losses = self.by_layer(pairs)
        check_layer_losses(self, losses, num_layers=1)
        return losses[0]

    def by_layer(self, pairs: MatchedPairs) -> Tensor:
        """Weighted loss of each layer.

        Args:
            pairs: M pairs of all L layers. If a subclass overrides `forward`, `forward` is called
                for the pairs of each layer. Otherwise `values` is called once.

        Returns:
            The losses. (L,)
        """
        if type(self).forward is not MapLoss.forward:
            return torch.stack([self(pairs.layer(number)) for number in range(pairs.num_layers)])
        layer_values = pairs.by_layer(self.values(pairs))  # split by layer, (L, M / L, ...)
        has_class_weights = isinstance(self.loss_weight, Sequence)
        if has_class_weights:
            weights = pairs.by_layer(class_weights(self.loss_weight, pairs.gt_labels))
            # The axes of layers and pairs are moved to the end, so that the weights (L, M / L) are
            # broadcast, and then back to the front.
            weighted = weights * layer_values.movedim((0, 1), (-2, -1))
            layer_values = weighted.movedim((-2, -1), (0, 1))
        sums = layer_values.flatten(1).sum(1) / pairs.avg_factor
        # Class weights have been applied to the values above.
        return sums if has_class_weights else self.loss_weight * sums


def check_layer_losses(loss: MapLoss, losses: Tensor, num_layers: int) -> None:
    """Require that a loss has returned one value for each layer.

    Args:
        loss: The loss, for the message.
        losses: What it has returned.
        num_layers: Number of layers.

    Raises:
        ValueError: If it is no tensor, or has another shape.
    """
    shape = tuple(losses.shape) if isinstance(losses, Tensor) else type(losses).__name__
    if shape != (num_layers,):
        raise InputError(
            f"{type(loss).__name__} must return one value for each of {num_layers} layers, got "
            f"the shape {shape}."
        )
