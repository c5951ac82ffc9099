"""BeMapNet's losses of one map class: lines, masks, control points, piece counts and curves.

A line is a curve of joined Bezier pieces. Points are (x, y) on the raster of the masks, whose row 0
is at the front: x is measured from the left, and y from the front.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from mmcv.ops import point_sample
from mmdet.models.utils import get_uncertain_point_coords_with_randomness
from torch import Tensor

from gsmap.models.base.matching import solve_assignment
from gsmap.models.bemapnet.curves import neighbourhood, recovery_loss
from gsmap.models.lines.losses import Case, LineLosses
from gsmap.utils.errors import InputError

# Names of the matching costs, for messages. Positions 0 and 1 come from `LineLosses.line_costs`.
COSTS = ("class scores", "masks", "control points", "pieces", "curves", "recovery")
OVERSAMPLING = 3.0  # random candidates per sampled point of a mask
UNCERTAIN = 0.9  # share of the sampled points at which the mask is least certain


class BezierLines(NamedTuple):
    """Predicted lines of one class, in one sample (n, ...) or in a batch (B, n, ...)."""

    logits: Tensor  # logits of a line and of no line (n, 2)
    controls: Tensor  # control points (from the left, from the front) in [0, 1] (n, P, 2)
    control_mask: Tensor  # True for points that the most likely number of pieces uses (n, P)
    piece_logits: Tensor  # logits of the number of pieces (n, k)
    curves: Tensor  # points (from the left, from the front) in [0, 1] (n, 100, 2)
    masks: Tensor  # logits (n, H, W)


class Pairs(NamedTuple):
    """Matched lines of a case, which is one class in one sample."""

    rows: Tensor  # indices of the predicted lines (M,)
    cols: Tensor  # indices of the annotated lines (M,)


class TrueCurves(NamedTuple):
    """Annotated lines of one class in one sample."""

    controls: Tensor  # (from the left, from the front) in [0, 1]; unused ones are 0 (K, P, 2)
    pieces: Tensor  # number of pieces minus one (K,)
    curves: Tensor  # points (from the left, from the front) in [0, 1] (K, 100, 2)
    masks: Tensor  # 0 and 1, float (K, H, W)


@dataclass(frozen=True)
class BezierLosses(LineLosses):
    """BeMapNet's losses and matching costs with their weights, by default as in the released code.

    Args:
        cls: Weight of the class in matching and loss.
        mask: Weight of the masks of lines in matching and loss.
        semantic: Weight of the masks of whole classes in the loss.
        none_weight: Weight of predictions without a matched line in the class loss.
        controls: Weight of the control points in matching and loss.
        pieces: Weight of the numbers of pieces in matching and loss.
        curve: Weight of the points of curves in matching and loss.
        recovery: Weight of the recovery loss in matching and loss. It is the dice loss of the
            annotated mask around the predicted curve, where the mask should be 1.
        mask_points: Number of points, >= 10, at which masks are compared: random points in
            matching, mostly the least certain points of the prediction in the loss. None compares
            all pixels.
        redrawn_in_px: Whether the targets of the curve loss are in pixels instead of [0, 1] for
            lines whose masks were drawn from their curves, as in the released code. Masks are drawn
            from the curves for all lines of a class if one of them is completely hidden by others
            of the class. This setting is used by the head, which creates the targets.

    Raises:
        ValueError: If ``mask_points`` is less than 10.
    """

    semantic: float = 0.5
    controls: float = 5.0
    pieces: float = 2.0
    curve: float = 10.0
    recovery: float = 1.0
    mask_points: int | None = 20000
    redrawn_in_px: bool = True

    def __post_init__(self) -> None:
        if self.mask_points is not None and self.mask_points < 10:
            raise InputError(f"mask_points must be >= 10 or None, got {self.mask_points}.")

    @torch.no_grad()
    def distances(self, masks: Sequence[Tensor], truths: Sequence[Tensor]) -> list[Tensor]:
        """Compute the distances of all pairs of masks, at random points shared by all samples.

        Args:
            masks: Logits of the predicted masks of each sample. (n, H, W) each
            truths: Annotated masks of each sample. (K, H, W) each

        Returns:
            Distances of each sample. (n, K) each
        """
        if self.mask_points is not None:
            points = torch.rand(1, self.mask_points, 2, device=masks[0].device)
            masks = [point_sample(mask[None], points)[0] for mask in masks]
            truths = [point_sample(truth[None], points)[0] for truth in truths]
        return super().distances(masks, truths)

    def mask_losses(self, masks: Tensor, truths: Tensor) -> Tensor:
        """Compute the losses of matched masks. (M, H, W) each -> (M,)"""
        if self.mask_points is not None and len(masks):
            masks = masks[:, None]
            truths = truths[:, None]
            with torch.no_grad():
                points = get_uncertain_point_coords_with_randomness(
                    masks,
                    labels=masks,  # not read for masks of one channel
                    num_points=self.mask_points,
                    oversample_ratio=OVERSAMPLING,
                    importance_sample_ratio=UNCERTAIN,
                )
            masks = point_sample(masks, points)[:, 0]
            truths = point_sample(truths, points)[:, 0]
        return super().mask_losses(masks, truths)

    def costs(self, case: Case) -> tuple[Tensor, ...]:
        """Compute the weighted costs of all pairs of a case.

        Args:
            case: Predicted lines (`BezierLines`) and annotated lines (`TrueCurves`) of one class in
                one sample, and the distances of their masks.

        Returns:
            A tuple of one tensor, with the costs in the order of `COSTS`. (6, n, K)
        """
        lines = case.lines
        truth = case.truth
        num_lines = lines.curves.shape[0]
        # The recovery cost needs the annotated masks at 25 pixels around each of the 100 points of
        # a predicted curve. The values of all n curves are read from the K masks at once.
        points = neighbourhood(lines.curves, truth.masks.shape[-2:])  # (n, 2500, 2)
        all_points = points.flatten(0, 1)
        mask_values = point_sample(truth.masks[None], all_points[None])[0]  # (K, n * 2500)
        mask_values = mask_values.unflatten(1, (num_lines, points.shape[1]))  # (K, n, 2500)
        # The inputs (n, 1, P, 2) and (K, P, 2) are broadcast to all pairs, which gives (n, K).
        controls_cost = self.controls * _mean_difference(lines.controls[:, None], truth.controls)
        piece_probs = lines.piece_logits.softmax(dim=-1)  # (n, k)
        pieces_cost = -self.pieces * piece_probs[:, truth.pieces]
        curve_cost = self.curve * _mean_difference(lines.curves[:, None], truth.curves)
        recovery_cost = self.recovery * recovery_loss(mask_values).T  # (n, K)
        curve_costs = torch.stack([controls_cost, pieces_cost, curve_cost, recovery_cost])
        return (torch.cat([self.line_costs(case), curve_costs]),)

    def pairs(self, case: Case, costs: list[Tensor]) -> Pairs:
        """Match the lines of a case one to one, with the least sum of costs.

        Args:
            case: Lines of one class in one sample.
            costs: List of one tensor, the result of `costs` on the CPU. (6, n, K)

        Returns:
            Indices of the matched lines, on the CPU.
        """
        # The names and the token are for the message of an error.
        rows, cols = solve_assignment(costs[0], COSTS, img_meta={"token": case.token})
        return Pairs(rows, cols)

    def __call__(self, cases: Sequence[Case], matches: Sequence[Pairs]) -> dict[str, Tensor]:
        """Compute the weighted losses of one layer and class.

        Args:
            cases: Lines of the class in each sample.
            matches: Matched lines of each case.

        Returns:
            ``mask``, ``controls``, ``pieces``, ``curve``, ``recovery`` and ``cls``, divided by the
            number of annotated lines except for ``cls``.
        """
        num_annotated = 0
        rows = []
        sample_lines = []
        sample_truths = []
        for case, match in zip(cases, matches, strict=True):
            num_annotated += len(case.truth.pieces)
            rows.append(match.rows)
            sample_lines.append(_select(case.lines, match.rows))
            sample_truths.append(_select(case.truth, match.cols))
        divisor = max(num_annotated, 1)
        lines: BezierLines = _concatenate(sample_lines)
        truth: TrueCurves = _concatenate(sample_truths)
        points = neighbourhood(lines.curves, truth.masks.shape[-2:])
        # Without a match, masks are not sampled, and any empty tensor serves.
        mask_values = lines.curves[..., 0]
        if len(mask_values):
            mask_values = point_sample(truth.masks[:, None], points)[:, 0]  # (M, 2500)
        # Unused control points are 0 in the targets, so they are set to 0 here.
        controls = lines.controls * lines.control_mask[..., None]
        pieces_loss = F.cross_entropy(lines.piece_logits, truth.pieces, reduction="none")
        line_losses = {
            "mask": self.mask * self.mask_losses(lines.masks, truth.masks),
            "controls": self.controls * _mean_difference(controls, truth.controls),
            "pieces": self.pieces * pieces_loss,
            "curve": self.curve * _mean_difference(lines.curves, truth.curves),
            "recovery": self.recovery * recovery_loss(mask_values),
        }
        losses = {}
        for name, value in line_losses.items():
            losses[name] = value.sum() / divisor
        losses["cls"] = self.class_loss(cases, rows)  # over all predictions, matched or not
        return losses


def _select(lines: Any, index: Tensor) -> Any:
    """Select lines in all fields of a tuple. (n, ...) each -> (M, ...) each"""
    fields = [values[index] for values in lines]
    return type(lines)._make(fields)


def _concatenate(samples: Sequence[Any]) -> Any:
    """Concatenate tuples of all samples field by field. (m, ...) each -> (M, ...) each"""
    fields = []
    for values in zip(*samples, strict=True):
        fields.append(torch.cat(values))
    return type(samples[0])._make(fields)


def _mean_difference(points: Tensor, others: Tensor) -> Tensor:
    """Return the mean absolute difference of coordinates. (..., P, 2) each -> (...,)"""
    return (points - others).abs().mean(dim=(-2, -1))
