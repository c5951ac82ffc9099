"""Base class of losses for the lines of one map class: matching, classification and masks."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from gsmap.structures.tensors import constant, upload

LINE = 0  # index of the logit of a line; the other logit stands for no line


class Case(NamedTuple):
    """Lines of one class in one sample.

    Attributes:
        lines: Object whose attributes are tensors (n, ...) of n predicted lines, such as ``logits``
            (n, 2).
        truth: Object whose attributes are tensors (K, ...) of K annotated lines, such as ``masks``
            (K, H, W).
        mask_distances: Distances between the masks. (n, K)
        token: Token of the sample.
    """

    lines: Any
    truth: Any
    mask_distances: Tensor
    token: str


@dataclass(frozen=True)
class LineLosses:
    """Base class of the losses of one map class.

    Args:
        cls: Weight of the classification, in losses and in matching.
        mask: Weight of the masks of lines, in losses and in matching.
        semantic: Weight of the masks of whole classes.
        none_weight: Weight, in the classification loss, of predictions without a match.
    """

    cls: float = 2.0
    mask: float = 5.0
    semantic: float = 3.0
    none_weight: float = 0.5

    def distances(self, masks: Sequence[Tensor], truths: Sequence[Tensor]) -> list[Tensor]:
        """Distances between all predicted and annotated masks of each sample.

        Args:
            masks: Logits of the predicted masks of each sample. (n, H, W) each
            truths: Annotated masks of each sample. (K, H, W) each

        Returns:
            Distances of each sample. (n, K) each
        """
        distances = []
        for sample_masks, sample_truths in zip(masks, truths, strict=True):
            distances.append(mask_distances(sample_masks, sample_truths))
        return distances

    def mask_losses(self, masks: Tensor, truths: Tensor) -> Tensor:
        """Distances between matched masks.

        Args:
            masks: Logits of the predicted masks. (M, H, W)
            truths: Annotated masks. (M, H, W)

        Returns:
            Distance of each pair. (M,)
        """
        # `mask_distances` returns the distances of all pairs (M, M). Matched pairs are on the
        # diagonal.
        return mask_distances(masks, truths).diagonal()

    @torch.no_grad()
    def match(self, cases: Sequence[Case]) -> list[Any]:
        """Match the lines of all cases.

        The costs of all cases are copied from the device at once, as one vector. The matched pairs
        of all cases are copied to the device at once, too.

        Args:
            cases: Cases of all decoder layers, classes and samples.

        Returns:
            The result of `pairs` for each case, on the device.

        Raises:
            FloatingPointError: If a cost is not finite. The method `pairs` checks the costs.
        """
        costs_by_case = []
        flat_costs: list[Tensor] = []
        lengths: list[int] = []  # number of entries of each cost
        for case in cases:
            costs = self.costs(case)
            costs_by_case.append(costs)
            for cost in costs:
                flat_costs.append(cost.flatten())
                lengths.append(cost.numel())
        vector = torch.cat(flat_costs)
        host_parts = iter(vector.cpu().split(lengths))  # one part for each cost, in this order
        matches = []
        for case, costs in zip(cases, costs_by_case, strict=True):
            host_costs = []
            for cost in costs:
                host_costs.append(next(host_parts).view(cost.shape))
            matches.append(self.pairs(case, host_costs))
        return _upload_tuples(matches, vector.device)

    def costs(self, case: Case) -> tuple[Tensor, ...]:
        """Costs of the matching of a case, of any shapes, on the device."""
        raise NotImplementedError

    def pairs(self, case: Case, costs: list[Tensor]) -> Any:
        """Match a case.

        Args:
            case: Lines of one class in one sample.
            costs: Result of the method `costs`, on the CPU.

        Returns:
            A NamedTuple of tensors on the CPU.

        Raises:
            FloatingPointError: If a cost is not finite.
        """
        raise NotImplementedError

    def __call__(self, cases: Sequence[Case], matches: Sequence[Any]) -> dict[str, Tensor]:
        """Weighted losses of the lines that one decoder layer predicts for one class, by name.

        Args:
            cases: Cases of this layer and class, one for each sample.
            matches: Results of `match` for these cases.
        """
        raise NotImplementedError

    def line_costs(self, case: Case) -> Tensor:
        """Weighted costs of classification and masks. (2, n, K)"""
        # Probability that a prediction is a line, repeated for each annotated line. (n, K)
        score = case.lines.logits.softmax(-1)[:, LINE, None].expand_as(case.mask_distances)
        return torch.stack([-self.cls * score, self.mask * case.mask_distances])

    def class_loss(self, cases: Sequence[Case], rows: Sequence[Tensor]) -> Tensor:
        """Weighted cross-entropy of the classification.

        Args:
            cases: Lines of the class in each sample.
            rows: Indices of the matched predictions of each case. (m,) each
        """
        logits = torch.cat([case.lines.logits for case in cases])
        labels = []
        for case, matched_rows in zip(cases, rows, strict=True):
            # All predictions begin as no line, and the matched ones become lines.
            case_labels = torch.full_like(case.lines.logits[:, 0], 1 - LINE).long()
            case_labels[matched_rows] = LINE
            labels.append(case_labels)
        # Weights of a line and of no line. `constant` uploads them only once.
        weights = constant(logits, [1.0, self.none_weight])
        return self.cls * F.cross_entropy(logits, torch.cat(labels), weight=weights)


def _upload_tuples(tuples: Sequence[Any], device: torch.device) -> list[Any]:
    """Copy NamedTuples of tensors to a device at once."""
    tensors: list[Tensor] = []
    for fields in tuples:
        tensors.extend(fields)
    copies = iter(upload(tensors, device))  # in the order of `tensors`
    result = []
    for fields in tuples:
        # A NamedTuple of the class of `fields`, filled with the next copies.
        result.append(fields._make(next(copies) for _ in fields))
    return result


def mask_distances(logits: Tensor, masks: Tensor) -> Tensor:
    """Mean binary cross-entropy plus dice distance of all pairs of masks.

    Args:
        logits: Logits of predicted masks. (n, H, W)
        masks: Target masks in {0, 1}. (K, H, W)

    Returns:
        Distances. (n, K)
    """
    logits = logits.flatten(1)
    masks = masks.flatten(1)
    probs = logits.sigmoid()
    # The cross-entropy of a pixel with logit x and target t is softplus(x) - x * t.
    entropy_sums = F.softplus(logits).sum(1, keepdim=True) - logits @ masks.T
    num_pixels = logits.shape[1]
    # Dice coefficient: twice the overlap of two masks, relative to the sum of their areas. The 1
    # makes it 1 for two empty masks.
    areas = probs.sum(1, keepdim=True) + masks.sum(1)  # (n, K)
    overlaps = 2 * probs @ masks.T
    dice = (overlaps + 1) / (areas + 1)
    return entropy_sums / num_pixels + 1 - dice
