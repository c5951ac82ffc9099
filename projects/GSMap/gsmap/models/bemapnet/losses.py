"""BeMapNet's losses of one map class: lines, masks, control points, numbers of pieces, curves."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from mmcv.ops import point_sample
from mmdet.models.utils import get_uncertain_point_coords_with_randomness
from torch import Tensor

from gsmap.models.base.matching import assigned
from gsmap.models.bemapnet.curves import around, missed
from gsmap.models.lines.losses import Case, LineLosses
from gsmap.utils.errors import InputError

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


class Pairs(NamedTuple):
    """Matched lines of a case."""

    rows: Tensor  # numbers of the predicted ones (M,)
    cols: Tensor  # and of the annotated ones (M,)


class TrueCurves(NamedTuple):
    """Annotated lines of one class in one sample."""

    controls: Tensor  # [0, 1] from the left and from the front; unused ones are 0 (K, P, 2)
    pieces: Tensor  # their number, less one (K,)
    curves: Tensor  # points (K, 100, 2)
    masks: Tensor  # 0 and 1, float (K, H, W)


@dataclass(frozen=True)
class BezierLosses(LineLosses):
    """Weights of losses and of matching costs; the defaults are the released ones.

    Masks are compared at ``mask_points`` points each, in matching at random ones, in losses mostly
    at those where the prediction is least certain; None compares all pixels. With
    ``redrawn_in_px``, as released, curves of lines whose masks were drawn by them are in pixels.
    Further weights are ``cls``, ``mask`` and ``none_weight`` of `LineLosses`.
    """

    semantic: float = 0.5  # masks of whole classes
    controls: float = 5.0  # control points, of matching too
    pieces: float = 2.0  # numbers of pieces, of matching too
    curve: float = 10.0  # points of curves, of matching too
    recovery: float = 1.0  # what curves miss of the masks, of matching too
    mask_points: int | None = 20000
    redrawn_in_px: bool = True

    def __post_init__(self) -> None:
        if self.mask_points is not None and self.mask_points < 10:
            raise InputError(f"mask_points must be >= 10 or None, got {self.mask_points}.")

    @torch.no_grad()
    def distances(self, masks: Sequence[Tensor], truths: Sequence[Tensor]) -> list[Tensor]:
        """Return distances of all masks of each sample, at the same points. (n, K) each"""
        if self.mask_points is not None:
            points = torch.rand(1, self.mask_points, 2, device=masks[0].device)
            masks, truths = (
                [point_sample(own[None], points)[0] for own in part] for part in (masks, truths)
            )
        return super().distances(masks, truths)

    def mask_losses(self, masks: Tensor, truths: Tensor) -> Tensor:
        """Return the distances of masks from what they should be. (M, H, W) each -> (M,)"""
        if self.mask_points is not None and len(masks):
            masks, truths = masks[:, None], truths[:, None]
            with torch.no_grad():
                points = get_uncertain_point_coords_with_randomness(
                    masks, masks, self.mask_points, OVERSAMPLING, UNCERTAIN
                )
            masks, truths = (point_sample(part, points)[:, 0] for part in (masks, truths))
        return super().mask_losses(masks, truths)

    def costs(self, case: Case) -> tuple[Tensor, ...]:
        """Return the weighted costs of all pairs of a case. (6, n, K)"""
        lines, truth = case.lines, case.truth
        points, size = around(lines.curves, truth.masks.shape[-2:]), lines.curves.shape[0]
        values = point_sample(truth.masks[None], points.flatten(0, 1)[None])[0]  # (K, n * 2500)
        own = [
            self.controls * _mean_apart(lines.controls[:, None], truth.controls),
            -self.pieces * lines.piece_logits.softmax(-1)[:, truth.pieces],
            self.curve * _mean_apart(lines.curves[:, None], truth.curves),
            self.recovery * missed(values.unflatten(1, (size, points.shape[1]))).T,
        ]
        return (torch.cat([self.line_costs(case), torch.stack(own)]),)

    def pairs(self, case: Case, costs: list[Tensor]) -> Pairs:
        """Match a case by its `costs`, on the CPU."""
        return Pairs(*assigned(costs[0], COSTS, {"token": case.token}))

    def __call__(self, cases: Sequence[Case], matches: Sequence[Pairs]) -> dict[str, Tensor]:
        """Return the weighted losses of a layer and class, from the cases of all samples."""
        number = max(sum(len(case.truth.pieces) for case in cases), 1)
        rows, cols = zip(*matches, strict=True)
        lines: BezierLines = _chosen([case.lines for case in cases], rows)
        truth: TrueCurves = _chosen([case.truth for case in cases], cols)
        around_px, values = around(lines.curves, truth.masks.shape[-2:]), lines.curves[..., 0]
        if len(values):
            values = point_sample(truth.masks[:, None], around_px)[:, 0]
        controls = lines.controls * lines.used[..., None]
        pieces = F.cross_entropy(lines.piece_logits, truth.pieces, reduction="none")
        sums = {
            "mask": self.mask * self.mask_losses(lines.masks, truth.masks),
            "controls": self.controls * _mean_apart(controls, truth.controls),
            "pieces": self.pieces * pieces,
            "curve": self.curve * _mean_apart(lines.curves, truth.curves),
            "recovery": self.recovery * missed(values),
        }
        losses = {name: value.sum() / number for name, value in sums.items()}
        return {**losses, "cls": self.class_loss(cases, rows)}


def _chosen(lines: Sequence[Any], indices: Sequence[Tensor]) -> Any:
    """Return the chosen lines of all samples as one tuple of them. (M, ...)"""
    picked = ([part[i] for part in own] for own, i in zip(lines, indices, strict=True))
    return type(lines[0])(*map(torch.cat, zip(*picked, strict=True)))


def _mean_apart(points: Tensor, others: Tensor) -> Tensor:
    """Return the mean difference of coordinates. (..., P, 2) each -> (...,)"""
    return (points - others).abs().mean((-2, -1))
