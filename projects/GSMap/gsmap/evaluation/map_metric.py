"""The metric class that the MMEngine runner calls: a thin shell around the evaluator."""

import sys
from collections.abc import Mapping, Sequence
from typing import Any

from mmdet3d.registry import METRICS
from mmengine.evaluator import BaseMetric
from mmengine.logging import MMLogger, print_log

from gsmap.datasets.elements import elements_of_predictions, elements_of_truth
from gsmap.evaluation.chamfer_ap import CHAMFER_THRESHOLDS, ChamferConfig
from gsmap.evaluation.evaluator import (
    METRIC_NAMES,
    EvaluationConfig,
    SampleMatches,
    flat_metrics,
    match_sample,
    reports,
)
from gsmap.evaluation.raster_ap import POLYGON_CLASSES, RasterConfig
from gsmap.evaluation.report import format_table
from gsmap.evaluation.results_json import vectors_of, write_results
from gsmap.structures.elements import MapElements


@METRICS.register_module()
class MapMetric(BaseMetric):
    """AP_chamfer and AP_raster of predicted map elements.

    Samples are matched as they come, so evaluation overlaps inference; what is kept and collected
    from the ranks are matches, never masks. Figures do not depend on the number of ranks, the
    order of the samples or the padding of the last batch.

    Args:
        eval: Metrics to compute: ``chamfer``, ``raster``; may be empty if only ``out_file`` is
            wanted.
        classes: Names of the classes; the data set's if left out.
        pc_range: (x_min, y_min, z_min, x_max, y_max, z_max) in metres, for the canvas of
            AP_raster; the data set's if left out.
        thresholds: Thresholds of AP_chamfer in metres.
        dim: Coordinates that AP_chamfer counts, 2 or 3; the data set's if left out.
        polygon_classes: Classes that AP_raster fills.
        out_file: Where to write the predictions in MapTR's JSON form, or None.
        **kwargs: ``collect_device``, ``collect_dir`` and ``prefix`` of ``BaseMetric``.

    Raises:
        ValueError: If a metric is unknown, there is nothing to do, or ``pc_range`` is malformed.
    """

    default_prefix = ""  # the keys carry the name of the metric already

    def __init__(
        self,
        eval: Sequence[str] = METRIC_NAMES,
        classes: Sequence[str] | None = None,
        pc_range: Sequence[float] | None = None,
        thresholds: Sequence[float] = CHAMFER_THRESHOLDS,
        dim: int | None = None,
        polygon_classes: Sequence[str] = POLYGON_CLASSES,
        out_file: str | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(**kwargs)
        unknown = set(eval) - set(METRIC_NAMES)
        if unknown or (not eval and out_file is None):
            raise ValueError(f"eval must name metrics of {METRIC_NAMES}, got {list(eval)}.")
        self.eval = tuple(eval)
        self.out_file = out_file
        self._settings: dict[str, Any] = {"classes": classes}
        if pc_range is not None:
            if len(pc_range) != 6:
                raise ValueError(f"pc_range must hold 6 values, got {len(pc_range)}.")
            self._settings["x_range"] = (pc_range[0], pc_range[3])
            self._settings["y_range"] = (pc_range[1], pc_range[4])
        self._thresholds = tuple(thresholds)
        self._dim = dim
        self._polygon_classes = tuple(polygon_classes)

    def _setting(self, key: str) -> Any:
        """Return a setting, or the data set's metainfo of the same name."""
        found = self._settings.get(key) or (self.dataset_meta or {}).get(key)
        if found is None:
            raise ValueError(
                f"MapMetric knows no {key}: set classes and pc_range, or use a data set whose "
                "metainfo has them."
            )
        return tuple(found)

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the classes."""
        return self._setting("classes")

    @property
    def config(self) -> EvaluationConfig | None:
        """Metrics and their rules; None if there is only a file to write."""
        if not self.eval:
            return None
        chamfer = raster = None
        if "chamfer" in self.eval:
            dim = self._dim or (self.dataset_meta or {}).get("dim", 2)
            chamfer = ChamferConfig(self.classes, self._thresholds, dim=dim)
        if "raster" in self.eval:
            x_range, y_range = (self._setting(key) for key in ("x_range", "y_range"))
            raster = RasterConfig(self.classes, self._polygon_classes, x_range, y_range)
        return EvaluationConfig(chamfer, raster)

    def process(self, data_batch: Any, data_samples: Sequence[Mapping[str, Any]]) -> None:
        """Match one batch and keep its matches.

        Args:
            data_batch: Not used.
            data_samples: Samples with ``token``, ``pred_instances_3d`` (``pts``, ``scores_3d``,
                ``labels_3d``) and, if a metric is asked for, ``eval_ann_info`` (``polylines``,
                ``labels``).
        """
        config = self.config
        for sample in data_samples:
            token = str(sample["token"])
            predictions = _predictions(sample["pred_instances_3d"], token)
            record: dict[str, Any] = {"token": token}
            if config is not None:
                record["matches"] = match_sample(token, predictions, _truth(sample), config)
            if self.out_file is not None:
                record["vectors"] = vectors_of(predictions, self.classes)
            self.results.append(record)

    def evaluate(self, size: int) -> dict[str, float]:
        """Collect the records of all ranks and compute the metrics.

        Args:
            size: Number of samples in the data set.
        """
        self._size = size
        # MMEngine would cut the list off at `size` by position; repeated samples go by their token
        return super().evaluate(sys.maxsize)

    def compute_metrics(self, results: list[dict[str, Any]]) -> dict[str, float]:
        """Compute the figures, print the tables and write the file; on the first rank only.

        Args:
            results: Records of all ranks.
        """
        unique = {record["token"]: record for record in reversed(results)}
        records = [unique[token] for token in sorted(unique)]
        expected = getattr(self, "_size", len(records))
        if len(records) != expected:
            print_log(
                f"MapMetric: {len(records)} different samples were scored, the data set has "
                f"{expected}.",
                "current",
                level=30,
            )
        if self.out_file is not None:
            samples = ((record["token"], record["vectors"]) for record in records)
            write_results(self.out_file, samples, {"classes": list(self.classes)})
            print_log(f"Results of {len(records)} samples written to {self.out_file}", "current")
        config = self.config
        if config is None:
            return {}
        matches: list[SampleMatches] = [record["matches"] for record in records]
        found = reports(matches, config)
        logger = MMLogger.get_current_instance()
        for report in found:
            logger.info("\n%s", format_table(report))
        return flat_metrics(found)


def _predictions(instances: Mapping[str, Any], token: str) -> MapElements:
    """Read the predictions of one sample."""
    try:
        return elements_of_predictions(instances)
    except ValueError as error:
        raise ValueError(f"predictions of sample {token}: {error}") from error


def _truth(sample: Mapping[str, Any]) -> MapElements:
    """Read the ground truth of one sample."""
    info = sample.get("eval_ann_info")
    if info is None:
        raise ValueError(
            f"sample {sample['token']} has no ground truth (eval_ann_info): it cannot be scored. "
            "Use an annotation file with instances, or eval=[] with an out_file."
        )
    return elements_of_truth(info)
