"""BeMapNet's head: lines as Bezier curves of several pieces."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import torch
import torch.nn.functional as F
from mmdet3d.registry import MODELS
from mmdet3d.structures import Det3DDataSample
from torch import Tensor, nn

from gsmap.models.base.coder import Tensors
from gsmap.models.base.layers import enlarged, mlp
from gsmap.models.base.parts import PARTS
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
    """What points are: (from the left, from the front) in [0, 1], along a curve."""

    grid: BEVGrid

    def decode(self, references: Tensor) -> Tensors:
        """Return the points in metres. (N, P, 2)"""
        return {"pts": self.grid.metres_from_front(references.flip(-1))}


@MODELS.register_module()
class BezierHead(LineHead):
    """Predict lines of classes that have degrees and numbers of pieces of their own (BeMapNet).

    Args:
        grid: The map's extent.
        classes: Names of the classes.
        queries: Lines of each class.
        degrees: Degrees of the pieces of each class, as in `FormatBezierTargets`.
        pieces: Most pieces of each class, likewise.
        decoder: Settings of `PointLineDecoder`; here a line is one query.
        bev_pixel_m: Side of a cell of the BEV features in metres, to which they are resized.
        to_end: Whether curves of several pieces reach their last joint; as released they do not.
        losses: Settings of `BezierLosses`.
        embed_dims: Channels C.
        hidden_dims: Hidden channels of the branches and of the map's coordinates.
        kwargs: Further arguments of `LineHead`.

    Raises:
        ValueError: If queries, degrees or pieces do not fit the classes, or there are more layers
            than weights.
    """

    transforms = ("FormatBezierTargets",)
    targets = "control points"
    level_weights = (0.5, 0.8, 1.2, 1.8)
    losses: BezierLosses

    def __init__(
        self,
        grid: BEVGrid,
        classes: Sequence[str],
        queries: Sequence[int] = (20, 25, 15),
        degrees: Sequence[int] = (2, 1, 3),
        pieces: Sequence[int] = (3, 1, 7),
        decoder: PARTS | None = None,
        bev_pixel_m: float = 0.3,
        to_end: bool = False,
        losses: PARTS | None = None,
        embed_dims: int = 512,
        hidden_dims: int = 256,
        **kwargs: Any,
    ) -> None:
        check_curves(degrees, pieces)
        if not len(queries) == len(degrees) == len(classes) or min(queries) < 1:
            raise InputError(
                f"queries (>= 1), degrees and pieces must be one for each of {list(classes)}, got "
                f"{list(queries)}, {list(degrees)} and {list(pieces)}."
            )
        own = {"queries": [(sum(queries), 1)], **(decoder or {})}, BezierLosses(**(losses or {}))
        kwargs |= {"embed_dims": embed_dims, "hidden_dims": hidden_dims}
        super().__init__(grid, classes, queries, *own, **kwargs)
        self.reference, self.queries = CurveReference(grid), queries
        self.bev_size = front_size(grid.rasterized(bev_pixel_m))
        shapes = list(zip(degrees, pieces, strict=True))
        self.curves = nn.ModuleList(Curve(*shape, to_end) for shape in shapes)
        hidden = (embed_dims, hidden_dims, hidden_dims)
        self.joint_branches, self.inner_branches, self.piece_branches = (
            nn.ModuleList(mlp(*hidden, n) if n else nn.Identity() for n in numbers)
            for numbers in (
                [(k + 1) * 2 * self.point_dims for _, k in shapes],
                [k * (d - 1) * 2 * self.point_dims for d, k in shapes],
                [k for _, k in shapes],
            )
        )

    @classmethod
    def target_settings(cls, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Return the settings of the transform that follow from those of the head."""
        curves = {name: settings[name] for name in ("degrees", "pieces")}
        return {**curves, **super().target_settings(settings)}

    def predictions(self, layer: Sequence[ClassLines], mean: Tensor) -> LinePredictions:
        """Return the curves and scores of a layer's lines of all classes."""
        ((states, logits, masks),) = layer
        parts = (part.split(list(self.queries), 1) for part in (states[:, :, 0], logits, masks))
        lines = [
            self.curved(label, *self.raw(label, own, mean), of_line.float(), mask.float())
            for label, (own, of_line, mask) in enumerate(zip(*parts, strict=True))
        ]
        scores = class_scores([own.logits for own in lines])
        return LinePredictions(scores, torch.cat([own.curves for own in lines], 1), lines)

    def raw(self, label: int, states: Tensor, mean: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return logits of joints, of inner points and of numbers of pieces, from (B, n, C).

        (B, n, k + 1, 2), (B, n, k, d - 1, 2), (B, n, k)
        """
        curve, coordinates = cast(Curve, self.curves[label]), (2, self.point_dims)
        joints = self.joint_branches[label](states).float().unflatten(-1, (-1, *coordinates)) @ mean
        pieces = self.piece_branches[label](states).float()
        shape = (pieces.shape[-1], curve.degree - 1)
        if curve.degree == 1:
            return joints, joints.new_zeros(*pieces.shape[:2], *shape, 2), pieces
        features = self.inner_branches[label](states).float()
        return joints, features.unflatten(-1, (*shape, *coordinates)) @ mean, pieces

    def curved(
        self,
        label: int,
        joints: Tensor,
        inner: Tensor,
        pieces: Tensor,
        logits: Tensor,
        masks: Tensor,
    ) -> BezierLines:
        """Return lines of a class from what `raw` says."""
        curve, last = cast(Curve, self.curves[label]), pieces.argmax(-1)
        controls = control_points(joints, inner)
        return BezierLines(logits, controls, curve.used(last), pieces, curve(controls, last), masks)

    def truth(self, sample: Det3DDataSample) -> list[TrueCurves]:
        """Return a sample's annotated lines, by class; ValueError if they are not of this head."""
        instances, found = self.annotated(sample), []
        points = self.grid.front_from_metres(instances.pts.float()).flip(-1)
        for label, curve in enumerate(cast(Iterable[Curve], self.curves)):
            own = instances.labels_3d == label
            numbers, most = instances.num_pts[own], curve.weights.shape[-1]
            if ((numbers > most) | ((numbers - 1) % curve.degree != 0)).any():
                raise InputError(
                    f"lines of class {label} have {numbers.tolist()} control points, but the head "
                    f"pieces of degree {curve.degree} and at most {most} points: set degrees and "
                    "pieces of FormatBezierTargets to those of the head."
                )
            pieces = (numbers - 1) // curve.degree - 1
            controls = F.pad(points[own, :most], (0, 0, 0, max(most - points.shape[1], 0)))
            controls = controls * curve.used(pieces)[..., None]
            drawn = curve(controls, pieces)
            if self.losses.redrawn_in_px:
                size = constant(drawn, self.mask_size).flip(0)
                drawn = torch.where(instances.redrawn[own, None, None], drawn * size, drawn)
            found.append(TrueCurves(controls, pieces, drawn, instances.masks[own].float()))
        return found

    def front(self, bev_feats: Tensor) -> Tensor:
        """Return BEV features from the front, in the head's cells. (B, C, H, W)"""
        return enlarged(super().front(bev_feats), self.bev_size)
