"""BeMapNet's head: lines as Bezier curves of several pieces."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, cast

import torch
import torch.nn.functional as F
from mmdet3d.registry import MODELS
from mmdet3d.structures import Det3DDataSample
from torch import Tensor, nn

from gsmap.models.bemapnet.curves import Curve, control_points
from gsmap.models.bemapnet.losses import BezierLines, BezierLosses, Case, TrueCurves
from gsmap.models.bemapnet.targets import check_curves
from gsmap.models.maptr.coder import Tensors
from gsmap.models.maptr.layers import mlp
from gsmap.models.maptr.parts import PARTS
from gsmap.models.pivotnet.decoder import ClassLines
from gsmap.models.pivotnet.front import front_size
from gsmap.models.pivotnet.lines import LineHead, LinePredictions, class_scores
from gsmap.structures.grid import BEVGrid

# of the losses of the class masks of BEV levels; of fewer, the last ones
LEVEL_WEIGHTS = (0.5, 0.8, 1.2, 1.8)


@dataclass(frozen=True)
class CurveReference:
    """What points are: (from the left, from the front) in [0, 1], along a curve."""

    grid: BEVGrid
    outputs = ("pts",)
    space = None
    metainfo: ClassVar[dict[str, Any]] = {}

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
        mask_pixel_m: Side of a pixel of the losses' masks in metres, as in the targets.
        bev_pixel_m: Side of a cell of the BEV features in metres, to which they are resized.
        to_end: Whether curves of several pieces reach their last joint; as released they do not.
        losses: Settings of `BezierLosses`.
        score_threshold: Lines of at most this score are dropped.
        embed_dims: Channels C.
        hidden_dims: Hidden channels of the branches and of the map's coordinates.
        point_dims: Channels of each coordinate of a point.

    Raises:
        ValueError: If queries, degrees or pieces do not fit the classes, or there are more layers
            than weights.
    """

    transforms = ("FormatBezierTargets",)
    targets = "control points"

    def __init__(
        self,
        grid: BEVGrid,
        classes: Sequence[str],
        queries: Sequence[int] = (20, 25, 15),
        degrees: Sequence[int] = (2, 1, 3),
        pieces: Sequence[int] = (3, 1, 7),
        decoder: PARTS | None = None,
        mask_pixel_m: float = 0.15,
        bev_pixel_m: float = 0.3,
        to_end: bool = False,
        losses: PARTS | None = None,
        score_threshold: float = 0.5,
        embed_dims: int = 512,
        hidden_dims: int = 256,
        point_dims: int = 64,
        init_cfg: dict | None = None,
    ) -> None:
        check_curves(degrees, pieces)
        if not len(queries) == len(degrees) == len(classes) or min(queries) < 1:
            raise ValueError(
                f"queries (>= 1), degrees and pieces must be one for each of {list(classes)}, got "
                f"{list(queries)}, {list(degrees)} and {list(pieces)}."
            )
        own = {"type": "PointLineDecoder", "queries": [(sum(queries), 1)], "embed_dims": embed_dims}
        super().__init__(
            grid,
            classes,
            MODELS.build({**own, **(decoder or {})}),
            queries,
            mask_pixel_m,
            BezierLosses(**(losses or {})),
            score_threshold,
            embed_dims,
            hidden_dims,
            point_dims,
            init_cfg,
        )
        self.reference, self.queries, self.point_dims = CurveReference(grid), queries, point_dims
        self.bev_size = front_size(grid.rasterized(bev_pixel_m))
        shapes = list(zip(degrees, pieces, strict=True))
        self.curves = nn.ModuleList(Curve(*shape, to_end) for shape in shapes)
        hidden = (embed_dims, hidden_dims, hidden_dims)
        self.joint_branches, self.inner_branches, self.piece_branches = (
            nn.ModuleList(mlp(*hidden, n) if n else nn.Identity() for n in numbers)
            for numbers in (
                [(k + 1) * 2 * point_dims for _, k in shapes],
                [k * (d - 1) * 2 * point_dims for d, k in shapes],
                [k for _, k in shapes],
            )
        )

    def forward(self, bev_outputs: Tensors) -> list[LinePredictions]:
        """Predict the lines after every decoder layer, from ``bev_feats`` (B, C, H, W)."""
        layers = self.decoder(self.front(bev_outputs["bev_feats"]))[1:]
        mean = self.coordinate_feature()
        return [self.predictions(own, mean) for (own,) in layers]

    def predictions(self, layer: ClassLines, mean: Tensor) -> LinePredictions:
        """Return the curves and scores of a layer's lines of all classes."""
        states, logits, masks = layer
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
                raise ValueError(
                    f"lines of class {label} have {numbers.tolist()} control points, but the head "
                    f"pieces of degree {curve.degree} and at most {most} points: set degrees and "
                    "pieces of FormatBezierTargets to those of the head."
                )
            pieces = (numbers - 1) // curve.degree - 1
            controls = F.pad(points[own, :most], (0, 0, 0, max(most - points.shape[1], 0)))
            controls = controls * curve.used(pieces)[..., None]
            drawn = curve(controls, pieces)
            if self.losses.redrawn_in_px:
                size = drawn.new_tensor(self.mask_size).flip(0)
                drawn = torch.where(instances.redrawn[own, None, None], drawn * size, drawn)
            found.append(TrueCurves(controls, pieces, drawn, instances.masks[own].float()))
        return found

    def cases(
        self, lines: BezierLines, truths: Sequence[TrueCurves], tokens: Sequence[str]
    ) -> list[Case]:
        """Return a layer's lines of a class by sample, with what is annotated."""
        lines = lines._replace(masks=self.enlarged(lines.masks))
        apart = self.losses.distances(list(lines.masks), [truth.masks for truth in truths])
        samples = zip(zip(*lines, strict=True), truths, apart, tokens, strict=True)
        return [Case(BezierLines(*own), *further) for own, *further in samples]

    def semantic_loss(
        self, levels: Sequence[Tensor], truths: Sequence[Sequence[TrueCurves]]
    ) -> Tensor:
        """Return the loss of the class masks of all BEV levels (B, classes, H, W)."""
        drawn = [torch.stack([own.masks.sum(0).clamp(max=1) for own in truth]) for truth in truths]
        by_class = torch.stack(drawn, 1)  # (classes, B, H, W)
        terms = [
            weight * self.losses.mask_losses(masks, own).mean()
            for weight, level in zip(LEVEL_WEIGHTS[-len(levels) :], levels, strict=True)
            for masks, own in zip(level.transpose(0, 1), by_class, strict=True)
        ]
        return self.losses.semantic * torch.stack(terms).sum() / len(levels)

    def front(self, bev_feats: Tensor) -> Tensor:
        """Return BEV features from the front, in the head's cells. (B, C, H, W)"""
        front = super().front(bev_feats)
        return F.interpolate(front, self.bev_size, mode="bilinear", align_corners=True)
