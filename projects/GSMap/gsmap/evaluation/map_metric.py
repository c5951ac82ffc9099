"""The metric class that the MMEngine runner calls: a thin shell around the evaluator."""

import sys
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

from mmdet3d.registry import METRICS
from mmengine.dist import all_gather_object
from mmengine.evaluator import BaseMetric
from mmengine.logging import MMLogger, print_log

from gsmap.datasets.elements import elements_of_predictions, elements_of_truth
from gsmap.evaluation.core.chamfer_ap import CHAMFER_THRESHOLDS
from gsmap.evaluation.core.evaluator import METRIC_NAMES, MapEvaluator
from gsmap.evaluation.core.metric import MetricSettings, metric_class, metric_names
from gsmap.evaluation.core.report import flat_metrics, format_table
from gsmap.evaluation.core.results_json import vectors_of, write_results
from gsmap.structures.grid import BEVGrid
from gsmap.utils.errors import InputError
from gsmap.utils.model_facts import CALIBRATION, CHECKPOINT
from gsmap.utils.split_lists import SPLIT_LIST, TRAINED_ON


@METRICS.register_module()
class MapMetric(BaseMetric):
    """AP_chamfer and AP_raster of predicted map elements.

    Samples are matched as they come; what is kept and collected from the ranks are matches, never
    masks. Figures do not depend on the number of ranks, the order of the samples or the padding of
    the last batch. Classes, range and coordinates per point are those of the data set's metainfo
    (``classes``, ``x_range``, ``y_range``, ``dim``).

    Args:
        eval: Names of the metrics to compute, as of ``tools/evaluate.py --eval``; may be empty if
            only ``out_file`` is wanted.
        thresholds: Thresholds of AP_chamfer in metres.
        out_file: Where to write the predictions in MapTR's JSON form, or None.
        **kwargs: ``collect_device``, ``collect_dir`` and ``prefix`` of ``BaseMetric``.

    Raises:
        ValueError: If a metric is unknown or there is nothing to do.
    """

    default_prefix = ""  # the keys carry the name of the metric already

    def __init__(
        self,
        eval: Sequence[str] = METRIC_NAMES,
        thresholds: Sequence[float] = CHAMFER_THRESHOLDS,
        out_file: str | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(**kwargs)
        if not eval and out_file is None:
            raise InputError(f"eval must name metrics of {metric_names()}, got none.")
        for name in eval:
            metric_class(name)
        self.eval = tuple(eval)
        self.thresholds = tuple(thresholds)
        self.out_file = out_file

    def _meta(self, key: str) -> Any:
        """Return an entry of the data set's metainfo."""
        if key not in (self.dataset_meta or {}):
            raise InputError(f"MapMetric needs a data set whose metainfo has {key}.")
        return self.dataset_meta[key]

    @cached_property
    def evaluator(self) -> MapEvaluator | None:
        """Metrics and their rules; None if there is only a file to write."""
        if not self.eval:
            return None
        classes = tuple(self._meta("classes"))
        meta = self.dataset_meta
        known = "x_range" in meta and "y_range" in meta
        settings = MetricSettings(
            classes,
            self.thresholds,
            dim=meta.get("dim", 2),
            grid=BEVGrid(meta["x_range"], meta["y_range"]) if known else None,
        )
        return MapEvaluator.named(self.eval, settings)

    def process(self, data_batch: Any, data_samples: Sequence[Mapping[str, Any]]) -> None:
        """Match one batch and keep its matches.

        Samples have ``token``, ``pred_instances_3d`` and, if a metric is asked for,
        ``eval_ann_info``, as ``datasets/elements.py`` reads them.
        """
        for sample in data_samples:
            token = str(sample["token"])
            try:
                predictions = elements_of_predictions(sample["pred_instances_3d"])
            except ValueError as error:
                raise InputError(f"predictions of sample {token}: {error}") from error
            record: dict[str, Any] = {"token": token}
            if self.evaluator is not None:
                info = sample.get("eval_ann_info")
                if info is None:
                    raise InputError(
                        f"sample {token} has no ground truth (eval_ann_info): it cannot be scored. "
                        "Use an annotation file with instances, or eval=[] with an out_file."
                    )
                truth = elements_of_truth(info)
                record["matches"] = self.evaluator.match(token, predictions, truth)
            if self.out_file is not None:
                record["vectors"] = vectors_of(predictions, self._meta("classes"))
            self.results.append(record)

    def evaluate(self, size: int) -> dict[str, float]:
        """Collect the records of all ranks and compute the metrics of ``size`` samples."""
        self._size = size
        # MMEngine joins ranks up to the shortest: ranks with whole drives have different lengths
        parts: list[list[dict[str, Any]]] = all_gather_object(self.results)  # type: ignore[has-type]
        self.results = [record for part in parts for record in part]
        # MMEngine would cut the list off at `size` by position; repeated samples go by their token
        return super().evaluate(sys.maxsize)

    def compute_metrics(self, results: list[dict[str, Any]]) -> dict[str, float]:
        """Compute the figures, print the tables and write the file; on the first rank only."""
        unique = {record["token"]: record for record in reversed(results)}
        records = [unique[token] for token in sorted(unique)]
        if len(records) != self._size:
            text = f"MapMetric: {len(records)} different samples were scored, the data set has "
            print_log(f"{text}{self._size}.", "current", level=30)
        reports = []
        if self.evaluator is not None:
            reports = self.evaluator.reports(record["matches"] for record in records)
        for report in reports:
            MMLogger.get_current_instance().info("\n%s", format_table(report))
        if self.out_file is not None:  # after the figures: a disk may be full
            samples = ((record["token"], record["vectors"]) for record in records)
            keys = SPLIT_LIST, TRAINED_ON, CHECKPOINT, CALIBRATION
            about = {key: said for key in keys if (said := self.dataset_meta.get(key))}
            write_results(self.out_file, samples, {"classes": list(self._meta("classes")), **about})
            print_log(f"Results of {len(records)} samples written to {self.out_file}", "current")
        return flat_metrics(reports)
