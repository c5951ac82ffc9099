"""What the losses of lines of one map class share: matching, the lines' class, masks."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from gsmap.structures.tensors import constant, uploaded

LINE = 0  # the place of a line's logit; the other one is of none


class Case(NamedTuple):
    """Lines of one class in one sample."""

    lines: Any  # as predicted (n, ...)
    truth: Any  # as annotated, among them ``masks`` (K, ...)
    apart: Tensor  # distances of their masks (n, K)
    token: str


@dataclass(frozen=True)
class LineLosses:
    """What the losses of one map class share: matching, the lines' class, masks."""

    cls: float = 2.0  # class, of matching too
    mask: float = 5.0  # masks of lines, of matching too
    semantic: float = 3.0  # masks of whole classes
    none_weight: float = 0.5  # predictions of no line in ``cls``

    def distances(self, masks: Sequence[Tensor], truths: Sequence[Tensor]) -> list[Tensor]:
        """Return distances of all masks of each sample. (n, K) each"""
        return [mask_distances(*pair) for pair in zip(masks, truths, strict=True)]

    def mask_losses(self, masks: Tensor, truths: Tensor) -> Tensor:
        """Return the distances of masks from what they should be. (M, H, W) each -> (M,)"""
        return mask_distances(masks, truths).diagonal()

    @torch.no_grad()
    def match(self, cases: Sequence[Case]) -> list[Any]:
        """Match the lines of each case; FloatingPointError if a cost is not a number.

        All costs are read from the device in one copy, and all pairs return in one.
        """
        parts = [self.costs(case) for case in cases]
        flat = torch.cat([part.flatten() for own in parts for part in own])
        values = iter(flat.cpu().split([part.numel() for own in parts for part in own]))
        read = ([next(values).view(part.shape) for part in own] for own in parts)
        matched = [self.pairs(*each) for each in zip(cases, read, strict=True)]
        there = iter(uploaded([part for own in matched for part in own], flat.device))
        return [own._make(islice(there, len(own))) for own in matched]

    def costs(self, case: Case) -> tuple[Tensor, ...]:
        """Return what the matching of a case reads; all cases are read in one copy."""
        raise NotImplementedError

    def pairs(self, case: Case, costs: list[Tensor]) -> Any:
        """Match a case by its `costs`, on the CPU; return a NamedTuple of tensors there."""
        raise NotImplementedError

    def __call__(self, cases: Sequence[Case], matches: Sequence[Any]) -> dict[str, Tensor]:
        """Return the weighted losses of a layer and class, from the cases of all samples."""
        raise NotImplementedError

    def line_costs(self, case: Case) -> Tensor:
        """Return the weighted costs of class and masks. (2, n, K)"""
        score = case.lines.logits.softmax(-1)[:, LINE, None].expand_as(case.apart)
        return torch.stack([-self.cls * score, self.mask * case.apart])

    def class_loss(self, cases: Sequence[Case], rows: Sequence[Tensor]) -> Tensor:
        """Return the weighted cross-entropy of lines, the matched rows of each case, and none."""
        logits = torch.cat([case.lines.logits for case in cases])
        labels = [torch.full_like(case.lines.logits[:, 0], 1 - LINE).long() for case in cases]
        for label, own in zip(labels, rows, strict=True):
            label[own] = LINE
        weights = constant(logits, [1.0, self.none_weight])
        return self.cls * F.cross_entropy(logits, torch.cat(labels), weights)


def mask_distances(logits: Tensor, masks: Tensor) -> Tensor:
    """Return mean cross-entropy + dice of all pairs of masks. (n, H, W), (K, H, W) -> (n, K)"""
    logits, masks = logits.flatten(1), masks.flatten(1)
    shares = logits.sigmoid()
    entropy = F.softplus(logits).sum(1, keepdim=True) - logits @ masks.T
    sizes = shares.sum(1, keepdim=True) + masks.sum(1)
    return entropy / logits.shape[1] + 1 - (2 * shares @ masks.T + 1) / (sizes + 1)
