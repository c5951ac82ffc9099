"""Draws samples while a model is validated or tested."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from mmdet3d.registry import HOOKS
from mmengine.hooks import Hook
from mmengine.runner import Runner

from gsmap.utils.errors import InputError, InputTypeError
from gsmap.utils.files import file_name
from gsmap.visualization.figure import sample_name, save_figure
from gsmap.visualization.map_visualizer import MapVisualizer


def _points(data_batch: Any, index: int) -> np.ndarray | None:
    """Return the LiDAR points of one sample of a batch, if it has any. (n, >= 2)"""
    clouds = data_batch.get("inputs", {}).get("points") if isinstance(data_batch, dict) else None
    return None if clouds is None else np.asarray(clouds[index].detach().cpu())


def _visualizer(runner: Runner) -> MapVisualizer:
    """Return the runner's visualizer, which must be ours."""
    if not isinstance(runner.visualizer, MapVisualizer):
        raise InputTypeError(
            "MapVisualizationHook needs visualizer=dict(type='MapVisualizer') in the config, "
            f"got {type(runner.visualizer).__name__}."
        )
    return runner.visualizer


@HOOKS.register_module()
@dataclass(eq=False)
class MapVisualizationHook(Hook):
    """Draws predictions: to ``test_out_dir`` in testing, to the backends in validation.

    Every rank draws its own samples in testing. In validation, rank 0 draws the same few samples
    each time, so that TensorBoard's slider shows how each improves.

    Args:
        draw: Whether to draw at all.
        interval: In testing, draw every ``interval``-th sample of a rank.
        num_val_samples: In validation, how many samples to draw.
        test_out_dir: Folder for the pictures of a test (``tools/test.py --show-dir``).

    Raises:
        ValueError: If ``interval`` is smaller than 1.
    """

    draw: bool = False
    interval: int = 1
    num_val_samples: int = 4
    test_out_dir: str | None = None
    _seen: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        if self.interval < 1:
            raise InputError(f"interval must be >= 1, got {self.interval}.")

    def after_val_iter(
        self, runner: Runner, batch_idx: int, data_batch: Any = None, outputs: Any = None
    ) -> None:
        """Draw the first sample of a few evenly spaced batches to the backends."""
        if not self.draw or not outputs or runner.rank != 0:
            return
        stride = max(len(runner.val_dataloader) // max(self.num_val_samples, 1), 1)
        if batch_idx % stride or batch_idx // stride >= self.num_val_samples:
            return
        name = file_name(f"val_{outputs[0].metainfo['token']}")
        points = _points(data_batch, 0)
        _visualizer(runner).add_datasample(name, None, outputs[0], step=runner.iter, points=points)

    def before_test_epoch(self, runner: Runner) -> None:
        """Start counting anew."""
        self._seen = 0

    def after_test_iter(
        self, runner: Runner, batch_idx: int, data_batch: Any = None, outputs: Any = None
    ) -> None:
        """Write the pictures of a batch to ``test_out_dir``."""
        if not self.draw or self.test_out_dir is None:
            return
        for index, sample in enumerate(outputs or ()):
            if self._seen % self.interval == 0:
                points = _points(data_batch, index)
                figure = _visualizer(runner).draw_sample(sample, points=points)
                save_figure(figure, Path(self.test_out_dir) / sample_name(sample.metainfo, ".jpg"))
            self._seen += 1

    def after_test_epoch(self, runner: Runner, metrics: dict[str, float] | None = None) -> None:
        """Say where the pictures are."""
        if self._seen:
            count = -(-self._seen // self.interval)
            runner.logger.info(f"{count} pictures of predictions are in {self.test_out_dir}.")
