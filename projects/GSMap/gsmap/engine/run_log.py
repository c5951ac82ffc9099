"""A training log that opens with what matters, in a few lines."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from mmdet3d.registry import HOOKS
from mmengine.dist import master_only
from mmengine.hooks import Hook
from mmengine.logging import MMLogger
from mmengine.model import is_model_wrapper
from mmengine.optim import AmpOptimWrapper
from mmengine.runner import EpochBasedTrainLoop, Runner
from torch import nn

from gsmap.engine.cpu_autocast import CPUAutocastOptimWrapper
from gsmap.engine.launch import newest_checkpoint, rank_timeout_s
from gsmap.engine.rank_watch import RankWatch
from gsmap.engine.resuming import refusing_state
from gsmap.utils.errors import NotFiniteError
from gsmap.utils.files import naming_file, write_text
from gsmap.utils.words import counted

# How mmengine's long records begin, and those that say nothing about the run
_DUMPS = (
    "\n" + "-" * 60 + "\nSystem environment", "Config:\n", "Hooks will be executed", "Exp name: ",
    '"FileClient" will be', '"HardDiskBackend" is the alias', "Distributed training is not used",
)  # fmt: skip


def _lower_dumps(record: logging.LogRecord) -> bool:
    """Give mmengine's dumps the level ``DEBUG``."""
    if record.getMessage().startswith(_DUMPS):
        record.levelno, record.levelname = logging.DEBUG, "DEBUG"
    return True


class MapRunner(Runner):
    """mmengine's runner with a short log: environment, config and hooks only with ``DEBUG``.

    The whole config stands in the work folder in any case. A rank that does not answer ends a run
    within ``env_cfg.dist_cfg.timeout``.
    """

    _watch: RankWatch | None = None

    @master_only
    def dump_config(self) -> None:
        """Write the whole config into the work folder, but never over the one that was read."""
        source = self.cfg.filename and Path(self.cfg.filename)
        target = Path(self.work_dir, source.name if source else f"{self.timestamp}.py")
        if source and target.exists() and source.exists() and target.samefile(source):
            self.logger.info(f"{target} stays as it is; the whole config is in {self.log_dir}.")
            return
        write_text(target, self.cfg.dump())

    def build_logger(self, *args: Any, **kwargs: Any) -> MMLogger:
        """Build mmengine's logger, which tells its dumps only if ``log_level`` is ``DEBUG``."""
        logger = super().build_logger(*args, **kwargs)
        logger.addFilter(_lower_dumps)
        return logger

    def train(self) -> nn.Module:
        """Train; where losses or weights are no longer finite, say what to lower.

        Raises:
            FloatingPointError: If they are not.
        """
        try:
            with naming_file(Path(self.work_dir)), self._watched():
                return super().train()
        except FloatingPointError as error:
            raise NotFiniteError(f"{error} {_what_to_lower(self)}") from error

    def test(self) -> dict:
        """Test."""
        with naming_file(Path(self.work_dir)), self._watched():
            return super().test()

    def resume(self, filename: str, *args: Any, **kwargs: Any) -> None:
        """Go on from a checkpoint.

        Raises:
            ValueError: If its state does not fit.
        """
        with refusing_state(filename):
            super().resume(filename, *args, **kwargs)

    def call_hook(self, fn_name: str, **kwargs: Any) -> None:
        """Call all hooks, and note that this rank goes on."""
        if self._watch:
            self._watch.step(f"{fn_name}, iteration {self.iter}")
        super().call_hook(fn_name, **kwargs)

    @contextmanager
    def _watched(self) -> Iterator[None]:
        """Watch for ranks that do not answer."""
        if self.world_size == 1:
            yield
            return
        with RankWatch(rank_timeout_s(self.cfg)) as self._watch:
            yield


def _what_to_lower(runner: Runner) -> str:
    """Say how to go on after a divergence; ``--resume`` keeps the learning rate."""
    last = newest_checkpoint(runner.work_dir)
    group = runner.optim_wrapper.param_groups[0]
    amp = isinstance(runner.optim_wrapper, (AmpOptimWrapper, CPUAutocastOptimWrapper))
    return (
        f"The training has diverged at iteration {runner.iter}: start it "
        f"{'from its last good checkpoint' if last else 'again'} with a lower learning rate than "
        f"{group.get('initial_lr', group['lr']):g}{' or without --amp' if amp else ''} (--work-dir "
        f"NEW --cfg-options {f'load_from={last} ' if last else ''}optim_wrapper.optimizer.lr=...)."
    )


@HOOKS.register_module()
class RunSummaryHook(Hook):
    """Logs what is trained, on what, for how long and where to, before the first iteration."""

    def before_train(self, runner: Runner) -> None:
        """Log it."""
        model = runner.model.module if is_model_wrapper(runner.model) else runner.model
        sizes = [(p.numel(), p.requires_grad) for p in model.parameters()]
        frozen = sum(size for size, trained in sizes if not trained)
        note = f", {frozen / 1e6:.2f} M of them frozen" if frozen else ""
        kind = f"{type(model).__name__} with {type(getattr(model, 'map_head', None)).__name__}"
        start = runner._load_from or "the config's initial weights"
        device = next(model.parameters()).device
        log_dir = getattr(runner, "log_dir", None) or runner._log_dir  # FlexibleRunner's is public
        lines = {
            "model": f"{kind}, {sum(size for size, _ in sizes) / 1e6:.2f} M parameters{note}",
            "start": f"goes on after iteration {runner.iter}" if runner.iter else f"from {start}",
            **_data(runner),
            "length": _length(runner),
            "runs on": f"{device}, {counted(torch.get_num_threads(), 'thread')}; "
            f"torch {torch.__version__}, seed {runner.seed}",
            "writes to": f"{runner.work_dir} (checkpoints, the whole config), {log_dir}",
        }
        text = "".join(f"\n    {name:<12}{value}" for name, value in lines.items())
        runner.logger.info(f"This run{text}")
        if missed := _missed_elements(runner, model):
            runner.logger.warning(missed)


def innermost(dataset: Any) -> Any:
    """Return the data set inside of wrappers, such as RepeatDataset."""
    while hasattr(dataset, "dataset"):
        dataset = dataset.dataset
    return dataset


def _data(runner: Runner) -> dict[str, str]:
    """Describe the data: how many samples, cameras, range and classes."""
    loaders = {"training": runner.train_dataloader}
    if runner.val_loop is not None:
        loaders["validation"] = runner.val_dataloader
    lines = {}
    for name, loader in loaders.items():
        dataset = innermost(loader.dataset)
        file = getattr(dataset, "ann_file", type(dataset).__name__)
        lines[name] = f"{counted(len(loader.dataset), 'sample')} of {file}"
    if not hasattr(dataset, "sample"):
        return lines
    cameras = dataset.sample(0).cameras
    names = dataset.cameras or [camera.name for camera in cameras]
    sizes = sorted({f"{camera.width} x {camera.height}" for camera in cameras})
    meta = dataset.metainfo
    ranges = ("{} from {:g} to {:g} m".format(axis, *meta[f"{axis}_range"]) for axis in "xy")
    lines["cameras"] = f"{len(names)}, their files {' and '.join(sizes)}"
    lines["map"] = f"{', '.join(ranges)}; {', '.join(meta['classes'])}"
    lines["elements"] = f"up to {_element_counts(runner.train_dataloader).max()} in a sample"
    return lines


def _element_counts(loader: Any) -> np.ndarray:
    """Return the number of map elements of each sample, 0 where it is not known."""
    return np.maximum(innermost(loader.dataset).annotations.instance_counts(), 0)


def _missed_elements(runner: Runner, model: Any) -> str | None:
    """Say how many elements no query is left for; None if there are enough."""
    groups = getattr(getattr(model, "map_head", None), "query_groups", None)
    if not groups or not hasattr(innermost(runner.train_dataloader.dataset), "annotations"):
        return None
    counts, queries = _element_counts(runner.train_dataloader), groups[0].num
    beyond = np.maximum(counts - queries, 0)
    if not beyond.any():
        return None
    return (
        f"{(beyond > 0).sum()} of {counted(len(counts), 'training sample')} have more elements (up "
        f"to {counts.max()}) than the model has queries ({queries}): {beyond.sum()} elements can "
        "never be found. Set model.map_head.query_groups=[dict(num=...)] to more (in the "
        "template _queries), or take a smaller range."
    )


def _length(runner: Runner) -> str:
    """Say how long the run is and how often it is validated."""
    loop, loader = runner.train_loop, runner.train_dataloader
    by_epoch = isinstance(loop, EpochBasedTrainLoop)
    text = f"{counted(loop.max_epochs, 'epoch')} of " if by_epoch else ""
    iterations = len(loader) if by_epoch else loop.max_iters
    unit = "epoch" if by_epoch else "iteration"
    validation = "no validation"
    if runner.val_loop is not None:
        validation = f"validation every {counted(loop.val_interval, unit)}"
    return (
        f"{text}{counted(iterations, 'iteration')}, {counted(loader.batch_size, 'sample')} x "
        f"{counted(runner.world_size, 'process')} each; {validation}"
    )
