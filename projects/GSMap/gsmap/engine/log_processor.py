"""Readable log lines of iterations and evaluations."""

import re
from typing import Any

from mmdet3d.registry import LOG_PROCESSORS
from mmengine.runner import LogProcessor, Runner

# Beginnings of the items that are removed from lines of iterations: losses of the layers before the
# last (``d0.loss_cls``), the time of data loading, and statistics of the Gaussians (``at_floor``
# and names with a slash).
_MINOR = re.compile(r"d\d+\.|data_time:|at_floor:|[\w.]+/[\w.]+:")
# Beginnings of the items that are removed from lines of evaluations: all metrics of `MapMetric`,
# except for names that end with AP or mAP, the APs of each class and group and their means. A name
# that ends with a threshold, such as ``AP@0.5``, is removed.
_DETAIL = re.compile(r"(.*/)?(chamfer|raster)/(?!.*\bm?AP:)")


@LOG_PROCESSORS.register_module()
class MapLogProcessor(LogProcessor):
    """mmengine's log processor with log lines that name only the main metrics.

    `MapMetric` computes about 180 metrics and logs its tables itself. TensorBoard and other
    backends, JSON logs and ``tools/test.py --metrics-out`` receive all metrics.
    """

    def get_log_after_iter(
        self, runner: Runner, batch_idx: int, mode: str
    ) -> tuple[dict[str, Any], str]:
        """Format the log of an iteration.

        Args:
            runner: Runner of the iteration.
            batch_idx: Index of the iteration within its epoch.
            mode: ``"train"``, ``"val"`` or ``"test"``.

        Returns:
            All scalars, and a log line with the losses of the last decoder layer only.
        """
        scalars, line = super().get_log_after_iter(runner, batch_idx=batch_idx, mode=mode)
        return scalars, _remove_items(line, pattern=_MINOR)

    def get_log_after_epoch(
        self, runner: Runner, batch_idx: int, mode: str, with_non_scalar: bool = False
    ) -> tuple[dict[str, Any], str]:
        """Format the log of an evaluation.

        Args:
            runner: Runner of the evaluation.
            batch_idx: Index of its last batch.
            mode: ``"val"`` or ``"test"``.
            with_non_scalar: Whether metrics that are not numbers are returned as well.

        Returns:
            All metrics, and a log line with the main ones.
        """
        metrics, line = super().get_log_after_epoch(
            runner, batch_idx=batch_idx, mode=mode, with_non_scalar=with_non_scalar
        )
        return metrics, _remove_items(line, pattern=_DETAIL)


def _remove_items(line: str, pattern: re.Pattern[str]) -> str:
    """Remove the items of a log line that match a pattern."""
    # mmengine writes the progress in brackets, then the items, all separated by two blanks.
    progress, _, items = line.partition("]  ")
    kept_texts = [f"{progress}]"]
    for item in items.split("  "):
        if item and not pattern.match(item):
            kept_texts.append(item)
    return "  ".join(kept_texts)
