"""Metric of the MMEngine runner, a thin wrapper around `MapEvaluator`."""

import logging
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

from mmdet3d.registry import METRICS
from mmengine.logging import MMLogger, print_log

from gsmap.datasets.elements import elements_of_predictions, elements_of_truth
from gsmap.evaluation.core.chamfer_ap import CHAMFER_THRESHOLDS, checked_thresholds
from gsmap.evaluation.core.evaluator import METRIC_NAMES, MapEvaluator
from gsmap.evaluation.core.metric import MetricSettings, metric_class, metric_names
from gsmap.evaluation.core.report import flat_metrics, format_table
from gsmap.evaluation.core.results_json import vectors_of, write_results
from gsmap.evaluation.gathered_metric import GatheredMetric
from gsmap.structures.grid import BEVGrid
from gsmap.utils.errors import InputError
from gsmap.utils.model_facts import CALIBRATION, CHECKPOINT, PRIORS
from gsmap.utils.split_lists import SPLIT_LIST, TRAINED_ON


@METRICS.register_module()
class MapMetric(GatheredMetric):
    """AP_chamfer and AP_raster of predicted map elements.

    Samples are matched as soon as they are predicted; only the matches are stored and collected
    from the ranks. Figures do not depend on the number of ranks, the order of the samples or the
    padding of the last batch. The metainfo of the data set defines the classes, the range of the
    map and the number of coordinates (``classes``, ``x_range``, ``y_range``, ``dim``).

    Args:
        eval: Names of the metrics to compute, as for ``tools/evaluate.py --eval``; may be empty if
            ``out_file`` is given.
        thresholds: Largest Chamfer distances of a match, in metres.
        out_file: Path at which predictions are written in MapTR's JSON form, or None.
        **kwargs: ``prefix`` of ``BaseMetric``. Its ``collect_device`` and ``collect_dir`` have no
            effect (`GatheredMetric`).

    Raises:
        ValueError: If a metric is unknown, a threshold is no number > 0, or neither a metric nor
            ``out_file`` is given.
    """

    default_prefix = ""  # the keys already contain the name of the metric

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
            metric_class(name)  # raises an error for an unknown name
        self.eval = tuple(eval)
        self.thresholds = checked_thresholds(thresholds)  # in ascending order
        self.out_file = out_file

    def _meta(self, key: str) -> Any:
        """Return an entry of the metainfo of the data set."""
        if key not in (self.dataset_meta or {}):
            raise InputError(f"MapMetric needs a data set whose metainfo has {key}.")
        return self.dataset_meta[key]

    @cached_property
    def evaluator(self) -> MapEvaluator | None:
        """Evaluator of the metrics; None if only a file is written."""
        if not self.eval:
            return None
        classes = tuple(self._meta("classes"))
        meta = self.dataset_meta
        grid = None
        if "x_range" in meta and "y_range" in meta:
            grid = BEVGrid(x_range=meta["x_range"], y_range=meta["y_range"])
        settings = MetricSettings(
            classes=classes, thresholds=self.thresholds, dim=meta.get("dim", 2), grid=grid
        )
        return MapEvaluator.from_names(self.eval, settings)

    def process(self, data_batch: Any, data_samples: Sequence[Mapping[str, Any]]) -> None:
        """Match the samples of one batch, and store a record of each sample.

        A record has the ``token``, the ``matches`` if metrics are computed, and the ``vectors``
        (elements in MapTR's JSON form) if a file is written.

        Args:
            data_batch: Not used.
            data_samples: Samples with ``token``, ``pred_instances_3d`` and, unless ``eval`` is
                empty, ``eval_ann_info``, the ground truth. ``datasets/elements.py`` defines and
                reads their form.

        Raises:
            ValueError: If predictions are malformed or ground truth is missing.
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
                record["matches"] = self.evaluator.match(token, predictions, ground_truth=truth)
            if self.out_file is not None:
                record["vectors"] = vectors_of(predictions, self._meta("classes"))
            self.results.append(record)

    def evaluate(self, size: int) -> dict[str, float]:
        """Collect the records of all ranks and compute the metrics of a data set of ``size``.

        Only the first rank computes. The others receive its figures.
        """
        self._size = size  # `compute_metrics` compares it with the number of different samples
        return super().evaluate(size)

    def compute_metrics(self, results: list[dict[str, Any]]) -> dict[str, float]:
        """Compute the figures, log the tables and write the file, on the first rank.

        Args:
            results: Records of all samples of all ranks; samples may be repeated.

        Returns:
            Figures by their flat keys, such as ``chamfer/mAP``.
        """
        # A sampler repeats samples to fill the last batch of a rank. The first record of a sample
        # counts: in reversed order, it is the last one to be written to the dict.
        unique = {record["token"]: record for record in reversed(results)}
        records = [unique[token] for token in sorted(unique)]
        if len(records) != self._size:
            text = (
                f"MapMetric: {len(records)} different samples were scored, the data set has "
                f"{self._size}."
            )
            print_log(text, logger="current", level=logging.WARNING)
        reports = []
        if self.evaluator is not None:
            reports = self.evaluator.reports(record["matches"] for record in records)
        for report in reports:
            MMLogger.get_current_instance().info("\n%s", format_table(report))
        if self.out_file is not None:  # written last, so that a full disk loses no figures
            samples = ((record["token"], record["vectors"]) for record in records)
            file_meta = {"classes": list(self._meta("classes"))}
            # The origin of the predictions: splits of the data, checkpoint, fit of the sigmas, maps
            # of earlier drives.
            for key in (SPLIT_LIST, TRAINED_ON, CHECKPOINT, CALIBRATION, PRIORS):
                if self.dataset_meta.get(key):
                    file_meta[key] = self.dataset_meta[key]
            write_results(self.out_file, samples=samples, meta=file_meta)
            text = f"Results of {len(records)} samples written to {self.out_file}"
            print_log(text, logger="current")
        return flat_metrics(reports)
