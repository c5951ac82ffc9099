"""Errors of the heights of predictions that match in the plane."""

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
from gsmap.structures.elements import FloatArray, MapElements
from gsmap.structures.polylines import resample_all


@register_metric
@dataclass(frozen=True)
class Heights(Metric):
    """Errors of the heights of predictions that match in the plane, at the largest threshold.

    Predictions are matched with the ground truth as for AP_chamfer, by x and y only. The height of
    each point of a prediction is then compared with the height of the point of its ground truth
    that is nearest in the plane.

    Args:
        classes: Names of the classes; a label is an index into them.
        thresholds: Largest Chamfer distances of a match in metres, in any order. The matches at the
            largest one are used.
        num_points: Number of points that each line is resampled to.

    Raises:
        ValueError: If ``classes`` are not valid names of classes.
    """

    name: ClassVar[str] = "heights"
    takes_thresholds: ClassVar[bool] = True

    classes: tuple[str, ...]
    thresholds: tuple[float, ...] = CHAMFER_THRESHOLDS
    num_points: int = 100

    def __post_init__(self) -> None:
        object.__setattr__(self, "classes", checked_classes(self.classes))

    @classmethod
    def from_settings(cls, settings: MetricSettings) -> "Heights":
        """Create the metric from the settings of a command or config."""
        thresholds = settings.thresholds or CHAMFER_THRESHOLDS
        return cls(classes=settings.classes, thresholds=thresholds)

    @property
    def counts_heights(self) -> bool:
        """Whether heights (z) count in the metric. This is True, as it compares heights."""
        return True

    def match(self, sample: Sample) -> SampleValues:
        """Measure the matches of one sample.

        Returns:
            Class indices ``labels`` (M,) of the M matched predictions, and their ``errors`` in
            metres (M, 2, P), which are the differences of heights and the distances in the plane.

        Raises:
            ValueError: If the predictions or the ground truth have no heights, a label does not fit
                the classes, or predictions have no scores.
        """
        token, predictions, truth = sample
        rules = ChamferConfig(
            classes=self.classes, thresholds=self.thresholds, num_points=self.num_points
        )
        matches = match_chamfer(predictions, truth, config=rules, token=token)
        pred_lines = self._resample(predictions)
        gt_lines = self._resample(truth)
        matched_gt = matches.matched_gt[:, -1]  # at the largest threshold; -1 without a match
        rows = np.flatnonzero(matched_gt >= 0)  # predictions with a match
        # The second axis has two entries: difference of heights, and distance in the plane.
        errors = np.empty((len(rows), 2, self.num_points))
        for index, row in enumerate(rows.tolist()):
            # `matches` are sorted by score. `pred_index` gives the position among the predictions.
            pred = pred_lines[matches.pred_index[row]]
            gt = gt_lines[matched_gt[row]]
            distance = np.linalg.norm(pred[:, None, :2] - gt[None, :, :2], axis=-1)  # (P, P)
            nearest = distance.argmin(axis=1)
            errors[index, 0] = pred[:, 2] - gt[nearest, 2]
            errors[index, 1] = distance.min(axis=1)
        # These arrays become columns of the table from which `reports` computes the means.
        return SampleValues(token, {"labels": matches.labels[rows], "errors": errors})

    def _resample(self, elements: MapElements) -> FloatArray:
        """Resample the lines of the predictions or of the ground truth in space. (N, P, 3)"""
        points = elements.with_coordinates(3).points
        return resample_all(points, elements.offsets, num_points=self.num_points)

    def reports(self, table: ValueTable) -> list[MetricReport]:
        """Compute the means over the matches of all samples.

        The keys of figures are ``CLASS/NAME``. ``height_error_m`` is the mean absolute difference
        of heights. ``height_bias_m`` is the mean difference, > 0 if predictions are too high.
        ``plane_error_m`` is the mean distance in the plane. These three are -1 for a class without
        matches. ``num_matches`` is the number of matches.

        Args:
            table: Values of all samples, from `match`.

        Returns:
            One report with the figures of all classes.
        """
        labels = np.concatenate(table.column("labels"))
        errors = np.concatenate(table.column("errors"))  # (matches, 2, P)
        figures: dict[str, float] = {}
        for label, name in enumerate(self.classes):
            is_class = labels == label
            class_errors = errors[is_class]
            heights = class_errors[:, 0].ravel()
            distances = class_errors[:, 1].ravel()
            figures[f"{name}/height_error_m"] = _mean(abs(heights))
            figures[f"{name}/height_bias_m"] = _mean(heights)
            figures[f"{name}/plane_error_m"] = _mean(distances)
            figures[f"{name}/num_matches"] = float(is_class.sum())
        return [MetricReport.of_figures(self.name, figures=figures, tokens=table.tokens)]


def _mean(values: FloatArray) -> float:
    """Compute the mean of values (n,); -1 without values."""
    return float(values.mean()) if len(values) else UNDEFINED
