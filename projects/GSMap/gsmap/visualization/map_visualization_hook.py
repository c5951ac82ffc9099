"""Hook that draws samples in validation and testing."""

import math
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
    """LiDAR points of one sample of a batch in the annotation frame, or None. (n, >= 2)"""
    if not isinstance(data_batch, dict):
        return None
    clouds = data_batch.get("inputs", {}).get("points")
    return None if clouds is None else np.asarray(clouds[index].detach().cpu())


def _visualizer(runner: Runner) -> MapVisualizer:
    """Visualizer of the runner, which must be a ``MapVisualizer``; otherwise TypeError."""
    if not isinstance(runner.visualizer, MapVisualizer):
        raise InputTypeError(
            "MapVisualizationHook needs visualizer=dict(type='MapVisualizer') in the config, "
            f"got {type(runner.visualizer).__name__}."
        )
    return runner.visualizer


@HOOKS.register_module()
@dataclass(eq=False)  # hooks are compared by identity
class MapVisualizationHook(Hook):
    """Hook that draws predictions: to a folder in testing, to visualizer backends in validation.

    In testing, each rank draws its samples. In validation, rank 0 draws a few fixed samples, so
    that the slider of TensorBoard shows their progress.

    Args:
        draw: Whether to draw at all.
        interval: In testing, draw every ``interval``-th sample of a rank.
        num_val_samples: Number of samples that are drawn in validation.
        test_out_dir: Folder for the pictures of a test (``tools/test.py --show-dir``); None to draw
            no pictures in testing.

    Raises:
        ValueError: If ``interval`` is smaller than 1.
    """

    draw: bool = False
    interval: int = 1
    num_val_samples: int = 4
    test_out_dir: str | None = None
    # Number of samples of this rank in the test so far; 0 if no pictures are drawn.
    _num_samples: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        if self.interval < 1:
            raise InputError(f"interval must be >= 1, got {self.interval}.")

    def after_val_iter(
        self, runner: Runner, batch_idx: int, data_batch: Any = None, outputs: Any = None
    ) -> None:
        """Draw the first sample of a few evenly spaced batches to the backends.

        Args:
            runner: Runner of the validation.
            batch_idx: Index of the batch.
            data_batch: Batch of the data loader.
            outputs: Samples with predictions.
        """
        if not self.draw or not outputs or runner.rank != 0:
            return
        # Number of batches between two drawn ones. Both maxima prevent a stride or a divisor of 0.
        stride = max(len(runner.val_dataloader) // max(self.num_val_samples, 1), 1)
        is_at_stride = batch_idx % stride == 0
        num_drawn = batch_idx // stride
        if not is_at_stride or num_drawn >= self.num_val_samples:
            return
        name = file_name(f"val_{outputs[0].metainfo['token']}")
        points = _points(data_batch, 0)
        visualizer = _visualizer(runner)
        # The image argument is None, so the original image files are drawn.
        visualizer.add_datasample(name, None, outputs[0], step=runner.iter, points=points)

    def before_test_epoch(self, runner: Runner) -> None:
        """Reset the number of tested samples."""
        self._num_samples = 0

    def after_test_iter(
        self, runner: Runner, batch_idx: int, data_batch: Any = None, outputs: Any = None
    ) -> None:
        """Write the pictures of a batch to ``test_out_dir``.

        Args:
            runner: Runner of the test.
            batch_idx: Index of the batch.
            data_batch: Batch of the data loader.
            outputs: Samples with predictions.
        """
        if not self.draw or self.test_out_dir is None:
            return
        for index, sample in enumerate(outputs or ()):
            if self._num_samples % self.interval == 0:
                points = _points(data_batch, index)
                figure = _visualizer(runner).draw_sample(sample, points=points)
                save_figure(figure, Path(self.test_out_dir) / sample_name(sample.metainfo, ".jpg"))
            self._num_samples += 1

    def after_test_epoch(self, runner: Runner, metrics: dict[str, float] | None = None) -> None:
        """Log the number of pictures of this rank and their folder.

        Args:
            runner: Runner of the test.
            metrics: Metrics of the test, not used.
        """
        if self._num_samples:
            count = math.ceil(self._num_samples / self.interval)
            runner.logger.info(f"{count} pictures of predictions are in {self.test_out_dir}.")
