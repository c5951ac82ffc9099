"""BeMapNet's losses of one map class: lines, masks, control points, numbers of pieces, curves."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from mmdet.models.utils import get_uncertain_point_coords_with_randomness
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from gsmap.models.bemapnet.curves import around, missed, sampled
from gsmap.models.maptr.matching import check_finite
from gsmap.models.pivotnet.lines import LINE
from gsmap.models.pivotnet.losses import mask_distances

COSTS = ("class scores", "masks", "control points", "pieces", "curves", "recovery")
OVERSAMPLING, UNCERTAIN = 3.0, 0.9  # of a mask's points: drawn per taken one, share of the taken


class BezierLines(NamedTuple):
    """Predicted lines of one class, in one sample (n, ...) or in a batch (B, n, ...)."""

    logits: Tensor  # of a line and of none (n, 2)
    controls: Tensor  # control points, [0, 1] from the left and from the front (n, P, 2)
    used: Tensor  # which of them the likeliest number of pieces has (n, P)
    piece_logits: Tensor  # of each number of pieces (n, k)
    curves: Tensor  # points, likewise (n, 100, 2)
    masks: Tensor  # logits (n, H, W)


class TrueCurves(NamedTuple):
    """Annotated lines of one class in one sample."""

    controls: Tensor  # [0, 1] from the left and from the front; unused ones are 0 (K, P, 2)
    pieces: Tensor  # their number, less one (K,)
    curves: Tensor  # points (K, 100, 2)
    masks: Tensor  # 0 and 1, float (K, H, W)


class Case(NamedTuple):
    """Lines of one class in one sample."""

    lines: BezierLines
    truth: TrueCurves
    apart: Tensor  # distances of their masks, in matching (n, K)
    token: str


@dataclass(frozen=True)
class BezierLosses:
    """Weights of losses and of matching costs; the defaults are the released ones.

    Masks are compared at ``mask_points`` points each, in matching at random ones, in losses mostly
    at those where the prediction is least certain; None compares all pixels. With
    ``redrawn_in_px``, as released, curves of lines whose masks were drawn by them are in pixels.
    """

    cls: float = 2.0  # class, of matching too
    mask: float = 5.0  # masks of lines, of matching too
    controls: float = 5.0  # control points, of matching too
    pieces: float = 2.0  # numbers of pieces, of matching too
    curve: float = 10.0  # points of curves, of matching too
    recovery: float = 1.0  # what curves miss of the masks, of matching too
    semantic: float = 0.5  # masks of whole classes
    none_weight: float = 0.5  # predictions of no line in ``cls``
    mask_points: int | None = 20000
    redrawn_in_px: bool = True

    def __post_init__(self) -> None:
        if self.mask_points is not None and self.mask_points < 10:
            raise ValueError(f"mask_points must be >= 10 or None, got {self.mask_points}.")

    @torch.no_grad()
    def distances(self, masks: Sequence[Tensor], truths: Sequence[Tensor]) -> list[Tensor]:
        """Return distances of all masks of each sample, at the same points. (n, K) each"""
        if self.mask_points is None:
            return [mask_distances(*pair) for pair in zip(masks, truths, strict=True)]
        points = torch.rand(1, self.mask_points, 2, device=masks[0].device)
        return [
            mask_distances(*(sampled(part[None], points)[0] for part in pair))
            for pair in zip(masks, truths, strict=True)
        ]

    def mask_losses(self, masks: Tensor, truths: Tensor) -> Tensor:
        """Return cross-entropy + dice of masks and what they should be. (M, H, W) each -> (M,)"""
        if not len(masks):
            return masks.sum((1, 2))
        if self.mask_points is None:
            return mask_distances(masks, truths).diagonal()
        masks, truths = masks[:, None], truths[:, None]
        with torch.no_grad():
            points = get_uncertain_point_coords_with_randomness(
                masks, masks, self.mask_points, OVERSAMPLING, UNCERTAIN
            )
        pair = (sampled(part, points)[:, 0] for part in (masks, truths))
        return mask_distances(*pair).diagonal()

    @torch.no_grad()
    def match(self, cases: Sequence[Case]) -> list[tuple[Tensor, Tensor]]:
        """Return matched predictions and annotations (M,) of each case.

        FloatingPointError if a cost is not a number.
        """
        costs = [self.costs(case) for case in cases]
        values = torch.cat([own.flatten() for own in costs]).cpu()  # one copy from the device
        arrays, pairs = values.split([own.numel() for own in costs]), []
        for case, own, array in zip(cases, costs, arrays, strict=True):
            cost = array.view(own.shape)
            check_finite(cost, COSTS, {"token": case.token})
            found = linear_sum_assignment(cost.sum(0).numpy())
            rows, cols = (torch.from_numpy(part).to(own.device) for part in found)
            pairs.append((rows, cols))
        return pairs

    def costs(self, case: Case) -> Tensor:
        """Return the weighted costs of all pairs of a case. (6, n, K)"""
        lines, truth = case.lines, case.truth
        score = lines.logits.softmax(-1)[:, LINE, None].expand_as(case.apart)
        points, size = around(lines.curves, truth.masks.shape[-2:]), lines.curves.shape[0]
        values = sampled(truth.masks[None], points.flatten(0, 1)[None])[0]  # (K, n * 2500)
        return torch.stack(
            [
                -self.cls * score,
                self.mask * case.apart,
                self.controls * _mean_apart(lines.controls[:, None], truth.controls),
                -self.pieces * lines.piece_logits.softmax(-1)[:, truth.pieces],
                self.curve * _mean_apart(lines.curves[:, None], truth.curves),
                self.recovery * missed(values.unflatten(1, (size, points.shape[1]))).T,
            ]
        )

    def __call__(
        self, cases: Sequence[Case], matches: Sequence[tuple[Tensor, Tensor]]
    ) -> dict[str, Tensor]:
        """Return the weighted losses of a layer and class, from the cases of all samples."""
        number = max(sum(len(case.truth.pieces) for case in cases), 1)
        labels = [torch.full_like(case.lines.logits[:, 0], 1 - LINE).long() for case in cases]
        for label, (rows, _) in zip(labels, matches, strict=True):
            label[rows] = LINE
        both = list(zip(cases, matches, strict=True))
        _, controls, used, piece_logits, curves, masks = (
            torch.cat(part)
            for part in zip(
                *([p[rows] for p in case.lines] for case, (rows, _) in both), strict=True
            )
        )
        true_controls, pieces, true_curves, true_masks = (
            torch.cat(part)
            for part in zip(
                *([p[cols] for p in case.truth] for case, (_, cols) in both), strict=True
            )
        )
        around_px = around(curves, true_masks.shape[-2:])
        values = sampled(true_masks[:, None], around_px)[:, 0] if len(curves) else curves[..., 0]
        logits = torch.cat([case.lines.logits for case in cases])
        classes = logits.new_tensor([1.0, self.none_weight])
        sums = {
            "mask": self.mask * self.mask_losses(masks, true_masks),
            "controls": self.controls * _mean_apart(controls * used[..., None], true_controls),
            "pieces": self.pieces * F.cross_entropy(piece_logits, pieces, reduction="none"),
            "curve": self.curve * _mean_apart(curves, true_curves),
            "recovery": self.recovery * missed(values),
        }
        return {
            **{name: value.sum() / number for name, value in sums.items()},
            "cls": self.cls * F.cross_entropy(logits, torch.cat(labels), classes),
        }


def _mean_apart(points: Tensor, others: Tensor) -> Tensor:
    """Return the mean difference of coordinates. (..., P, 2) each -> (...,)"""
    return (points - others).abs().mean((-2, -1))
