"""Base of the metrics of the MMEngine runner, which gathers the records of all ranks."""

from itertools import chain
from typing import Any

from mmengine.dist import all_gather_object, broadcast_object_list, is_main_process
from mmengine.evaluator import BaseMetric


class GatheredMetric(BaseMetric):
    """Metric whose first rank gets the records of all ranks, and computes the figures.

    mmengine's method writes the records to a folder that all ranks must share, and cuts them at the
    size of the data set. Here they are sent, and none is cut: ranks that predict whole drives have
    different numbers of samples, and samplers repeat some.
    """

    def evaluate(self, size: int) -> dict[str, float]:
        """Compute the figures of a data set, and clear the records.

        Args:
            size: Number of samples of the data set; not used.

        Returns:
            Figures by name, with the prefix of the metric; equal on all ranks.
        """
        parts = all_gather_object(self.results)
        figures: list[Any] = [None]
        if is_main_process():
            computed = self.compute_metrics(list(chain.from_iterable(parts)))
            prefix = f"{self.prefix}/" if self.prefix else ""
            figures = [{f"{prefix}{name}": value for name, value in computed.items()}]
        broadcast_object_list(figures)
        self.results.clear()
        return figures[0]
