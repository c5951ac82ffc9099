"""Log lines of evaluations that can be read."""

import re
from typing import Any

from mmdet3d.registry import LOG_PROCESSORS
from mmengine.runner import LogProcessor, Runner

# Of an iteration: layers before the last, Gaussians, the time that loading takes
_MINOR = re.compile(r"d\d+\.|data_time:|at_floor:|[\w.]+/[\w.]+:")
# All figures of MapMetric but the APs of classes and groups and their means
_DETAIL = re.compile(r"(.*/)?(chamfer|raster)/(?!.*\bm?AP$)")


@LOG_PROCESSORS.register_module()
class MapLogProcessor(LogProcessor):
    """mmengine's log processor, whose lines name only the main figures.

    `MapMetric` has some 180 figures and logs its tables itself. Backends such as TensorBoard, JSON
    logs and ``tools/test.py --metrics-out`` get all of them.
    """

    def get_log_after_iter(self, runner: Runner, batch_idx: int, mode: str) -> tuple[dict, str]:
        """Return all figures of an iteration, and a log line with the last layer's losses alone."""
        figures, line = super().get_log_after_iter(runner, batch_idx, mode)
        head, _, rest = line.partition("]  ")
        items = [item for item in rest.split("  ") if item and not _MINOR.match(item)]
        return figures, "  ".join([f"{head}]", *items])

    def get_log_after_epoch(
        self, runner: Runner, batch_idx: int, mode: str, with_non_scalar: bool = False
    ) -> tuple[dict[str, Any], str]:
        """Return all figures of an evaluation, and the log line with the main ones."""
        self._details: dict[str, Any] = {}
        figures, line = super().get_log_after_epoch(runner, batch_idx, mode, with_non_scalar)
        return {**self._details, **figures}, line

    def _collect_scalars(
        self, custom_cfg: list[dict], runner: Runner, mode: str, reserve_prefix: bool = False
    ) -> dict[str, Any]:
        """Put the details of an evaluation aside, before mmengine makes its line."""
        figures = super()._collect_scalars(custom_cfg, runner, mode, reserve_prefix)
        if mode != "train":
            self._details = {
                name: figures.pop(name) for name in list(figures) if _DETAIL.match(name)
            }
        return figures
