"""How far off the heights of predictions are that match in the plane."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from gsmap.evaluation.core.chamfer_ap import CHAMFER_THRESHOLDS, ChamferConfig, match_chamfer
from gsmap.evaluation.core.matches import checked_classes
from gsmap.evaluation.core.metric import (
    Metric,
    MetricSettings,
    Sample,
    SampleValues,
    ValueTable,
    register_metric,
)
from gsmap.evaluation.core.report import UNDEFINED, MetricReport
from gsmap.structures.polylines import resample_all


@register_metric
@dataclass(frozen=True)
class Heights(Metric):
    """Errors of the heights of predictions that match in the plane, at the loosest threshold.

    Each of the points of a prediction is compared with the nearest of its ground truth's.

    Args:
        classes: Names of the classes; a label is an index into them.
        thresholds: Of AP_chamfer, in metres.
        num_points: Points that each line is resampled to.
    """

    name: ClassVar[str] = "heights"

    classes: tuple[str, ...]
    thresholds: tuple[float, ...] = CHAMFER_THRESHOLDS
    num_points: int = 100

    def __post_init__(self) -> None:
        object.__setattr__(self, "classes", checked_classes(self.classes))

    @classmethod
    def of(cls, settings: MetricSettings) -> "Heights":
        """Return the metric by the settings of a command or config."""
        return cls(settings.classes, settings.thresholds or CHAMFER_THRESHOLDS)

    @property
    def counts_heights(self) -> bool:
        """True: both sides need heights."""
        return True

    def match(self, sample: Sample) -> SampleValues:
        """Measure the matches of one sample.

        Raises:
            ValueError: If a side has no heights.
        """
        token, predictions, truth = sample
        flat = ChamferConfig(self.classes, self.thresholds, self.num_points)
        matches = match_chamfer(predictions, truth, flat, token)
        pred, gt = (
            resample_all(side.with_coordinates(3).points, side.offsets, self.num_points)
            for side in (predictions, truth)
        )
        matched = matches.matched_gt[:, -1]
        rows = np.flatnonzero(matched >= 0)
        apart = np.empty((len(rows), 2, self.num_points))
        for place, row in enumerate(rows.tolist()):
            line, other = pred[matches.pred_index[row]], gt[matched[row]]
            distance = np.linalg.norm(line[:, None, :2] - other[None, :, :2], axis=-1)  # (P, P)
            nearest = distance.argmin(axis=1)
            apart[place] = line[:, 2] - other[nearest, 2], distance.min(axis=1)
        return SampleValues(token, {"labels": matches.labels[rows], "apart": apart})

    def reports(self, table: ValueTable) -> list[MetricReport]:
        """Compute the means over the matches of all samples.

        Figures are, by ``CLASS/NAME``: ``height_error_m``, the mean absolute difference,
        ``height_bias_m``, its mean with sign (predictions too high: > 0), ``plane_error_m``, the
        mean distance in the plane, and ``num_matches``; -1 without matches.
        """
        labels = np.concatenate(table.column("labels"))
        apart = np.concatenate(table.column("apart"))
        figures: dict[str, float] = {}
        for label, name in enumerate(self.classes):
            heights, plane = apart[labels == label].transpose(1, 0, 2).reshape(2, -1)
            for key, values in (
                ("height_error_m", abs(heights)),
                ("height_bias_m", heights),
                ("plane_error_m", plane),
            ):
                figures[f"{name}/{key}"] = float(values.mean()) if len(values) else UNDEFINED
            figures[f"{name}/num_matches"] = float((labels == label).sum())
        return [MetricReport.of_figures(self.name, figures, table.tokens)]
