"""Runner with a short training log, and a summary of the run at the start of the log."""

import logging
from collections.abc import Callable, Iterator
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
from mmengine.optim import AmpOptimWrapper, OptimWrapper, OptimWrapperDict
from mmengine.runner import EpochBasedTrainLoop, Runner
from torch import nn

from gsmap.checkpoints.convert import summarize_names
from gsmap.engine.cpu_autocast import CPUAutocastOptimWrapper
from gsmap.engine.launch import newest_checkpoint, rank_timeout_s
from gsmap.engine.rank_watch import RankWatch
from gsmap.engine.resuming import refusing_state
from gsmap.utils.errors import NotFiniteError
from gsmap.utils.files import add_path_to_errors, write_text
from gsmap.utils.words import format_count

# Beginnings of mmengine's long log records, and of its records that do not concern the run.
_DUMPS = (
    "\n" + "-" * 60 + "\nSystem environment", "Config:\n", "Hooks will be executed", "Exp name: ",
    '"FileClient" will be', '"HardDiskBackend" is the alias', "Distributed training is not used",
)  # fmt: skip


def _lower_dumps(record: logging.LogRecord) -> bool:
    """Set the level of mmengine's long records to ``DEBUG``. As a log filter, keep all records."""
    if record.getMessage().startswith(_DUMPS):
        record.levelno = logging.DEBUG
        record.levelname = "DEBUG"
    return True


class MapRunner(Runner):
    """mmengine's runner with a short log: environment, config and hooks appear only in ``DEBUG``.

    The complete config is written to the work folder at any log level. If a rank does not answer,
    the run ends within ``env_cfg.dist_cfg.timeout`` (`RankWatch`).
    """

    _watch: RankWatch | None = None  # watch of all ranks; None for a single rank

    @master_only
    def dump_config(self) -> None:
        """Write the complete config to the work folder, unless it would replace its source."""
        if not self.cfg.filename:
            write_text(Path(self.work_dir, f"{self.timestamp}.py"), text=self.cfg.dump())
            return
        source = Path(self.cfg.filename)
        target = Path(self.work_dir, source.name)
        if target.exists() and source.exists() and target.samefile(source):
            self.logger.info(f"{target} stays as it is; the whole config is in {self.log_dir}.")
            return
        write_text(target, text=self.cfg.dump())

    def build_logger(
        self, log_level: int | str = "INFO", log_file: str | None = None, **kwargs: Any
    ) -> MMLogger:
        """Build mmengine's logger with its long records at level ``DEBUG``.

        Args:
            log_level: Lowest level of the records that are logged.
            log_file: File of the log; None for the default place in the work folder.
            **kwargs: Further arguments of ``MMLogger``.
        """
        logger = super().build_logger(log_level=log_level, log_file=log_file, **kwargs)
        logger.addFilter(_lower_dumps)
        return logger

    def train(self) -> nn.Module:
        """Run the training.

        Raises:
            FloatingPointError: If losses or weights become NaN or infinite; the message names
                settings to lower.
        """
        try:
            # A failed write, as on a full disk, is reported with the work folder.
            with add_path_to_errors(Path(self.work_dir)), self._watch_ranks():
                return super().train()
        except FloatingPointError as error:
            raise NotFiniteError(f"{error} {_divergence_advice(self)}") from error

    def test(self) -> dict:
        """Run the test loop and return its metrics."""
        with add_path_to_errors(Path(self.work_dir)), self._watch_ranks():
            return super().test()

    def resume(
        self,
        filename: str,
        resume_optimizer: bool = True,
        resume_param_scheduler: bool = True,
        map_location: str | Callable = "default",
    ) -> None:
        """Load the state of a run from a checkpoint.

        Args:
            filename: File of the checkpoint.
            resume_optimizer: Whether to load the state of the optimizer.
            resume_param_scheduler: Whether to load the states of the schedulers.
            map_location: Device of the loaded tensors, as in ``torch.load``.

        Raises:
            ValueError: If the state does not fit this run.
        """
        with refusing_state(path=filename):
            super().resume(
                filename,
                resume_optimizer=resume_optimizer,
                resume_param_scheduler=resume_param_scheduler,
                map_location=map_location,
            )

    def scale_lr(self, optim_wrapper: OptimWrapper, auto_scale_lr: dict | None = None) -> None:
        """Scale the learning rate from the base batch size to the samples of an optimizer step.

        mmengine leaves out that an optimizer step with accumulated gradients has the samples of
        ``accumulative_counts`` iterations.

        Args:
            optim_wrapper: Optimizer of the training, or several of them.
            auto_scale_lr: Settings ``enable`` and ``base_batch_size``; None scales nothing.
        """
        wrappers: list[Any] = [optim_wrapper]
        if isinstance(optim_wrapper, OptimWrapperDict):
            wrappers = list(optim_wrapper.values())
        for wrapper in wrappers:
            settings = dict(auto_scale_lr or {})
            base_batch_size = settings.get("base_batch_size")
            iterations = getattr(wrapper, "_accumulative_counts", 1)
            if settings.get("enable") and base_batch_size and iterations > 1:
                # rate * (batch * iterations) / base = rate * batch / (base / iterations)
                settings["base_batch_size"] = float(base_batch_size) / iterations
                self.logger.info(
                    f"An optimizer step has the gradients of {iterations} iterations, so its base "
                    f"batch size of {base_batch_size} is {settings['base_batch_size']:g} per "
                    "iteration."
                )
            super().scale_lr(wrapper, settings)

    def call_hook(self, fn_name: str, **kwargs: Any) -> None:
        """Call a method of all hooks, and record in `RankWatch` that this rank begins a step."""
        if self._watch:
            self._watch.step(f"{fn_name}, iteration {self.iter}")
        super().call_hook(fn_name, **kwargs)

    @contextmanager
    def _watch_ranks(self) -> Iterator[None]:
        """Context that ends the run if a rank does not answer; does nothing for a single rank."""
        if self.world_size == 1:
            yield
            return
        # `call_hook` reports the steps of this rank to the watch.
        with RankWatch(rank_timeout_s(self.cfg)) as self._watch:
            yield


def _divergence_advice(runner: Runner) -> str:
    """Return advice to start a new run after a divergence with a lower learning rate.

    ``--resume`` would keep the learning rate.
    """
    checkpoint = newest_checkpoint(runner.work_dir)
    if checkpoint:
        start = "from its last good checkpoint"
        load_from = f"load_from={checkpoint} "
    else:
        start = "again"
        load_from = ""
    group = runner.optim_wrapper.param_groups[0]
    # Rate at the start of the schedule; only a schedule stores ``initial_lr``.
    learning_rate = group.get("initial_lr", group["lr"])
    uses_amp = isinstance(runner.optim_wrapper, (AmpOptimWrapper, CPUAutocastOptimWrapper))
    amp_advice = " or without --amp" if uses_amp else ""
    return (
        f"The training has diverged at iteration {runner.iter}: start it {start} with a lower "
        f"learning rate than {learning_rate:g}{amp_advice} (--work-dir NEW --cfg-options "
        f"{load_from}optim_wrapper.optimizer.lr=...)."
    )


@HOOKS.register_module()
class RunSummaryHook(Hook):
    """Logs model, data, length, device and output folder before the first iteration."""

    def before_train(self, runner: Runner) -> None:
        """Log the summary."""
        model = runner.model.module if is_model_wrapper(runner.model) else runner.model
        if runner.iter:
            start = f"goes on after iteration {runner.iter}"
        else:
            # `_load_from` is the checkpoint of the setting ``load_from``, or None.
            source = runner._load_from or "the config's initial weights"
            start = f"from {source}"
        device = next(model.parameters()).device
        threads = format_count(torch.get_num_threads(), noun="thread")
        # `FlexibleRunner` has only `log_dir`, and `Runner` of some versions only `_log_dir`.
        log_dir = getattr(runner, "log_dir", None) or runner._log_dir
        lines = {
            "model": _describe_model(model),
            "start": start,
            **_describe_data(runner),
            "length": _describe_length(runner),
            "runs on": f"{device}, {threads}; torch {torch.__version__}, seed {runner.seed}",
            "writes to": f"{runner.work_dir} (checkpoints, the whole config), {log_dir}",
        }
        text = "".join(f"\n    {name:<12}{value}" for name, value in lines.items())
        runner.logger.info(f"This run{text}")
        warning = _missed_elements_warning(runner, model=model)
        if warning:
            runner.logger.warning(warning)


def _describe_model(model: nn.Module) -> str:
    """Return the classes of a model and its head, and the number of parameters in millions."""
    total = 0
    frozen = 0
    for parameter in model.parameters():
        total += parameter.numel()
        if not parameter.requires_grad:
            frozen += parameter.numel()
    head = getattr(model, "map_head", None)
    frozen_note = f", {frozen / 1e6:.2f} M of them frozen" if frozen else ""
    return (
        f"{type(model).__name__} with {type(head).__name__}, {total / 1e6:.2f} M "
        f"parameters{frozen_note}"
    )


def innermost(dataset: Any) -> list[Any]:
    """Return the data sets inside of wrappers such as ``RepeatDataset`` and ``ConcatDataset``."""
    if hasattr(dataset, "datasets"):
        wrapped = dataset.datasets
    elif hasattr(dataset, "dataset"):
        wrapped = [dataset.dataset]
    else:
        return [dataset]
    datasets = []
    for inner_dataset in wrapped:
        datasets += innermost(inner_dataset)
    return datasets


def _describe_data(runner: Runner) -> dict[str, str]:
    """Return log lines with the number of samples, the cameras, the map range and the classes."""
    loaders = {"training": runner.train_dataloader}
    if runner.val_loop is not None:
        loaders["validation"] = runner.val_dataloader
    lines = {}
    datasets = []
    for name, loader in loaders.items():
        inner_datasets = innermost(loader.dataset)
        files = []
        for inner in inner_datasets:
            files.append(getattr(inner, "ann_file", type(inner).__name__))
        samples = format_count(len(loader.dataset), noun="sample")
        lines[name] = f"{samples} of {summarize_names(list(dict.fromkeys(files)))}"
        datasets += inner_datasets
    if not all(hasattr(dataset, "sample") for dataset in datasets):
        return lines
    cameras = []  # records of the first sample of each data set
    for dataset in datasets:
        cameras += dataset.sample(0).cameras
    # Without a selection in the config, `cameras` of a data set is None: all cameras are used.
    names = datasets[0].cameras or {camera.name for camera in datasets[0].sample(0).cameras}
    sizes = set()
    for camera in cameras:
        sizes.add(f"{camera.width} x {camera.height}")
    meta = datasets[0].metainfo  # the map is equal in all data sets
    x_min, x_max = meta["x_range"]
    y_min, y_max = meta["y_range"]
    lines["cameras"] = f"{len(names)}, their files {' and '.join(sorted(sizes))}"
    lines["map"] = (
        f"x from {x_min:g} to {x_max:g} m, y from {y_min:g} to {y_max:g} m; "
        f"{', '.join(meta['classes'])}"
    )
    most_elements = _element_counts(dataset=runner.train_dataloader.dataset).max()
    lines["elements"] = f"up to {most_elements} in a sample"
    return lines


def _element_counts(dataset: Any) -> np.ndarray:
    """Return the number of map elements of each sample, 0 if unknown. (number of samples,)"""
    if hasattr(dataset, "datasets"):
        return np.concatenate([_element_counts(inner) for inner in dataset.datasets])
    if hasattr(dataset, "dataset"):
        counts = _element_counts(dataset=dataset.dataset)
        # Samples of `RepeatDataset`, or else of `ClassBalancedDataset`, `CBGSDataset` or `Subset`.
        indices = np.arange(len(dataset)) % len(counts)
        for name in ("repeat_indices", "sample_indices", "indices"):
            indices = getattr(dataset, name, indices)
        return counts[np.asarray(indices)]
    return np.maximum(dataset.instance_counts(), 0)


def _missed_elements_warning(runner: Runner, model: Any) -> str | None:
    """Return a warning if training samples have more elements than the model has queries."""
    groups = getattr(getattr(model, "map_head", None), "query_groups", None)
    datasets = innermost(runner.train_dataloader.dataset)
    if not groups or not all(hasattr(dataset, "instance_counts") for dataset in datasets):
        return None
    counts = _element_counts(dataset=runner.train_dataloader.dataset)
    queries = groups[0].num  # only the first group is used in prediction
    excess = np.maximum(counts - queries, 0)
    if not excess.any():
        return None
    samples = format_count(len(counts), noun="training sample")
    num_crowded = (excess > 0).sum()
    return (
        f"{num_crowded} of {samples} have more elements (up to {counts.max()}) than the "
        f"model has queries ({queries}): {excess.sum()} elements can never be found. Set "
        "model.map_head.query_groups=[dict(num=...)] (_queries in the template) to a larger "
        "number, or use a smaller range."
    )


def _describe_length(runner: Runner) -> str:
    """Return the number of epochs and iterations, the batch size and the validation interval."""
    loop = runner.train_loop
    loader = runner.train_dataloader
    if isinstance(loop, EpochBasedTrainLoop):
        unit = "epoch"
        epochs = format_count(loop.max_epochs, noun="epoch")
        length = f"{epochs} of {format_count(len(loader), noun='iteration')}"
    else:
        unit = "iteration"
        length = format_count(loop.max_iters, noun="iteration")
    validation = "no validation"
    if runner.val_loop is not None:
        validation = f"validation every {format_count(loop.val_interval, noun=unit)}"
    return (
        f"{length}, {format_count(loader.batch_size, noun='sample')} x "
        f"{format_count(runner.world_size, noun='process')} each; {validation}"
    )
