"""BeMapNet's head, which predicts lines as Bezier curves of several pieces."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import torch
import torch.nn.functional as F
from mmdet3d.registry import MODELS
from mmdet3d.structures import Det3DDataSample
from torch import Tensor, nn

from gsmap.models.base.coder import Tensors
from gsmap.models.base.layers import mlp, resize_map
from gsmap.models.base.parts import PartConfig
from gsmap.models.base.references import Reference
from gsmap.models.bemapnet.curves import Curve, control_points
from gsmap.models.bemapnet.losses import BezierLines, BezierLosses, TrueCurves
from gsmap.models.bemapnet.targets import check_curves
from gsmap.models.lines.decoder import ClassLines
from gsmap.models.lines.front import front_size
from gsmap.models.lines.head import LineHead, LinePredictions, class_scores
from gsmap.structures.grid import BEVGrid
from gsmap.structures.tensors import constant
from gsmap.utils.errors import InputError


@dataclass(frozen=True)
class CurveReference(Reference):
    """References of points along curves: distances from the left and the front edge of the map.

    Both distances are in [0, 1].

    Args:
        grid: Extent of the map, in metres.
    """

    grid: BEVGrid

    def decode(self, references: Tensor) -> Tensors:
        """Decode references (N, P, 2) to ``pts`` in metres. (N, P, 2)"""
        # The grid takes the distance from the front first.
        return {"pts": self.grid.metres_from_front(references.flip(-1))}


@MODELS.register_module()
class BezierHead(LineHead):
    """Head of Bezier curves with a degree and a largest number of pieces per class (BeMapNet).

    A curve of k pieces of degree d has k + 1 joints, the ends of its pieces, and d - 1 inner
    control points in each piece.

    Args:
        grid: Extent of the map, in metres.
        classes: Names of the classes.
        queries: Number of lines of each class.
        degrees: Degree of the pieces of each class, as in `FormatBezierTargets`.
        pieces: Largest number of pieces of each class, as in `FormatBezierTargets`.
        decoder: Settings of `PointLineDecoder`, in which a line is one query.
        bev_pixel_m: Side in metres of the cells to which BEV features are resized.
        to_end: Whether curves of several pieces reach their last joint. In the released code they
            end before it.
        losses: Settings of `BezierLosses`.
        embed_dims: Channels C of the lines and of the BEV features.
        hidden_dims: Hidden channels of the branches, and of the network that computes a feature of
            D channels for each coordinate (x, y) of the map.
        kwargs: Further arguments of `LineHead`.

    Raises:
        ValueError: If queries, degrees or pieces do not fit the classes, or if there are more
            decoder layers than loss weights.
    """

    transforms = ("FormatBezierTargets",)
    targets = "control points"  # for error messages
    level_weights = (0.5, 0.8, 1.2, 1.8)  # of the losses of class masks, by BEV level
    losses: BezierLosses

    def __init__(
        self,
        grid: BEVGrid,
        classes: Sequence[str],
        queries: Sequence[int] = (20, 25, 15),
        degrees: Sequence[int] = (2, 1, 3),
        pieces: Sequence[int] = (3, 1, 7),
        decoder: PartConfig | None = None,
        bev_pixel_m: float = 0.3,
        to_end: bool = False,
        losses: PartConfig | None = None,
        embed_dims: int = 512,
        hidden_dims: int = 256,
        **kwargs: Any,
    ) -> None:
        check_curves(degrees, pieces)
        has_all_classes = len(queries) == len(degrees) == len(classes)
        if not has_all_classes or min(queries) < 1:
            raise InputError(
                f"queries (>= 1), degrees and pieces must be one for each of {list(classes)}, got "
                f"{list(queries)}, {list(degrees)} and {list(pieces)}."
            )
        super().__init__(
            grid,
            classes,
            numbers=queries,
            # One group of lines for all classes together, with one point query per line.
            decoder={"queries": [(sum(queries), 1)], **(decoder or {})},
            losses=BezierLosses(**(losses or {})),
            embed_dims=embed_dims,
            hidden_dims=hidden_dims,
            **kwargs,
        )
        self.reference = CurveReference(grid)
        self.queries = queries
        self.bev_size = front_size(grid.rasterized(bev_pixel_m))
        self.curves = nn.ModuleList()
        self.joint_branches = nn.ModuleList()
        self.inner_branches = nn.ModuleList()
        self.piece_branches = nn.ModuleList()
        dims_per_point = 2 * self.point_dims  # D channels for each of the two coordinates
        # Three loops, because the order of creation determines the random initial weights.
        for degree, num_pieces in zip(degrees, pieces, strict=True):
            self.curves.append(Curve(degree, num_pieces, to_end=to_end))
            joint_dims = (num_pieces + 1) * dims_per_point
            self.joint_branches.append(mlp(embed_dims, hidden_dims, hidden_dims, joint_dims))
        for degree, num_pieces in zip(degrees, pieces, strict=True):
            inner_branch: nn.Module = nn.Identity()  # curves of degree 1 have no inner points
            if degree > 1:
                inner_dims = num_pieces * (degree - 1) * dims_per_point
                inner_branch = mlp(embed_dims, hidden_dims, hidden_dims, inner_dims)
            self.inner_branches.append(inner_branch)
        for num_pieces in pieces:
            self.piece_branches.append(mlp(embed_dims, hidden_dims, hidden_dims, num_pieces))

    @classmethod
    def target_settings(cls, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Return the settings of `FormatBezierTargets` that follow from the head's settings."""
        curves = {"degrees": settings["degrees"], "pieces": settings["pieces"]}
        return {**curves, **super().target_settings(settings)}

    def predictions(self, layer: Sequence[ClassLines], mean: Tensor) -> LinePredictions:
        """Predict the curves of all classes and their scores.

        Args:
            layer: Lines of all classes from one decoder layer, as one entry.
            mean: Mean of the features of all coordinates of the map. (D,)
        """
        # The decoder has one kind of lines, of one point each, for all classes together.
        ((states, logits, masks),) = layer
        numbers = list(self.queries)
        class_states = states[:, :, 0].split(numbers, dim=1)
        class_logits = logits.split(numbers, dim=1)
        class_masks = masks.split(numbers, dim=1)
        lines = []
        line_logits = []
        curves = []
        for label in range(len(numbers)):
            joints, inner, pieces = self.curve_logits(label, class_states[label], mean=mean)
            class_lines = self.build_lines(
                label,
                joints,
                inner=inner,
                pieces=pieces,
                logits=class_logits[label].float(),
                masks=class_masks[label].float(),
            )
            lines.append(class_lines)
            line_logits.append(class_lines.logits)
            curves.append(class_lines.curves)
        return LinePredictions(
            scores=class_scores(line_logits), references=torch.cat(curves, dim=1), lines=lines
        )

    def curve_logits(
        self, label: int, states: Tensor, mean: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Predict the logits of curves of one class, of degree d and at most k pieces.

        Args:
            label: Class index.
            states: States of the lines. (B, n, C)
            mean: Mean of the features of all coordinates of the map. The logit of a coordinate is
                the scalar product of this mean and D outputs of a branch. (D,)

        Returns:
            Logits of the joints (B, n, k + 1, 2), of the inner points (B, n, k, d - 1, 2) and of
            the numbers of pieces (B, n, k).
        """
        degree = cast(Curve, self.curves[label]).degree
        point_shape = (2, self.point_dims)  # D channels for each of the two coordinates
        joint_feats = self.joint_branches[label](states).float()
        joints = self.coordinates_of(joint_feats.unflatten(-1, (-1, *point_shape)), mean)
        pieces = self.piece_branches[label](states).float()
        inner_shape = (pieces.shape[-1], degree - 1)  # (k, d - 1)
        if degree == 1:
            inner = joints.new_zeros((*pieces.shape[:2], *inner_shape, 2))  # an empty tensor
        else:
            inner_feats = self.inner_branches[label](states).float()
            inner_feats = inner_feats.unflatten(-1, (*inner_shape, *point_shape))
            inner = self.coordinates_of(inner_feats, mean)
        return joints, inner, pieces

    def build_lines(
        self,
        label: int,
        joints: Tensor,
        inner: Tensor,
        pieces: Tensor,
        logits: Tensor,
        masks: Tensor,
    ) -> BezierLines:
        """Compute the curves of one class from logits.

        Args:
            label: Class index.
            joints: Logits of the joints. (B, n, k + 1, 2)
            inner: Logits of the inner points. (B, n, k, d - 1, 2)
            pieces: Logits of the numbers of pieces. (B, n, k)
            logits: Logits of a line and of no line. (B, n, 2)
            masks: Logits of the lines' masks. (B, n, H, W)
        """
        curve = cast(Curve, self.curves[label])
        piece_index = pieces.argmax(dim=-1)  # number of pieces less one (B, n)
        controls = control_points(joints, inner)
        return BezierLines(
            logits=logits,
            controls=controls,
            control_mask=curve.control_mask(piece_index),
            piece_logits=pieces,
            curves=curve(controls, piece_index),
            masks=masks,
        )

    def truth(self, sample: Det3DDataSample) -> list[TrueCurves]:
        """Return the annotated lines of a sample for each class.

        Raises:
            ValueError: If the sample has no targets, or targets that do not fit the head.
        """
        instances = self.line_targets(sample)
        # The grid returns the distance from the front first. Control points have it second.
        points = self.grid.front_from_metres(instances.pts.float()).flip(-1)
        truths = []
        for label, curve in enumerate(cast(Iterable[Curve], self.curves)):
            is_class = instances.labels_3d == label
            counts = instances.num_pts[is_class]  # numbers of control points
            largest = curve.weights.shape[-1]  # largest number of control points of a curve
            has_too_many = counts > largest
            # Complete pieces have a multiple of the degree plus one control points.
            has_half_pieces = (counts - 1) % curve.degree != 0
            if (has_too_many | has_half_pieces).any():
                raise InputError(
                    f"lines of class {label} have {counts.tolist()} control points, but the head "
                    f"has pieces of degree {curve.degree} and at most {largest} points: set "
                    "degrees and pieces of FormatBezierTargets to the values of the head."
                )
            piece_index = (counts - 1) // curve.degree - 1  # number of pieces less one
            num_missing = max(largest - points.shape[1], 0)
            # All lines get `largest` control points. The unused ones are set to 0.
            controls = F.pad(points[is_class, :largest], (0, 0, 0, num_missing))
            controls = controls * curve.control_mask(piece_index)[..., None]
            curves = curve(controls, piece_index)
            if self.losses.redrawn_in_px:
                # As in the released code, lines whose masks were drawn from their control points
                # (`FormatBezierTargets`) have their curves in pixels.
                size = constant(curves, self.mask_size).flip(0)  # (columns, rows), as points (x, y)
                is_redrawn = instances.redrawn[is_class, None, None]
                curves = torch.where(is_redrawn, curves * size, curves)
            class_truth = TrueCurves(
                controls=controls,
                pieces=piece_index,
                curves=curves,
                masks=instances.masks[is_class].float(),
            )
            truths.append(class_truth)
        return truths

    def front(self, bev_feats: Tensor) -> Tensor:
        """Rotate BEV features to the front and resize them to the head's cells. (B, C, H, W)"""
        return resize_map(super().front(bev_feats), self.bev_size)
