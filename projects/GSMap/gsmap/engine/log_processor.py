"""Log lines of evaluations that can be read."""

import re
from typing import Any

from mmdet3d.registry import LOG_PROCESSORS
from mmengine.runner import LogProcessor

# Of an iteration: layers before the last, Gaussians, the time that loading takes
_MINOR = re.compile(r"d\d+\.|data_time:|at_floor:|[\w.]+/[\w.]+:")
# All figures of MapMetric but the APs of classes and groups and their means
_DETAIL = re.compile(r"(.*/)?(chamfer|raster)/(?!.*\bm?AP:)")


@LOG_PROCESSORS.register_module()
class MapLogProcessor(LogProcessor):
    """mmengine's log processor, whose lines name only the main figures.

    `MapMetric` has some 180 figures and logs its tables itself. Backends such as TensorBoard, JSON
    logs and ``tools/test.py --metrics-out`` get all of them.
    """

    def get_log_after_iter(self, *args: Any, **kwargs: Any) -> tuple[dict[str, Any], str]:
        """Return all figures of an iteration, and a log line with the last layer's losses alone."""
        figures, line = super().get_log_after_iter(*args, **kwargs)
        return figures, _without(line, _MINOR)

    def get_log_after_epoch(self, *args: Any, **kwargs: Any) -> tuple[dict[str, Any], str]:
        """Return all figures of an evaluation, and the log line with the main ones."""
        figures, line = super().get_log_after_epoch(*args, **kwargs)
        return figures, _without(line, _DETAIL)


def _without(line: str, minor: re.Pattern[str]) -> str:
    """Leave figures out of a log line."""
    head, _, rest = line.partition("]  ")
    items = [item for item in rest.split("  ") if item and not minor.match(item)]
    return "  ".join([f"{head}]", *items])
