"""Checkpoint hook with atomic writes, and loading that runs no code from a checkpoint."""

import json
import re
from pathlib import Path
from typing import Any

import torch
from mmdet3d.registry import HOOKS
from mmengine.dist import all_gather_object, broadcast_object_list
from mmengine.fileio import LocalBackend, register_backend
from mmengine.hooks import CheckpointHook
from mmengine.optim import OptimWrapper
from mmengine.runner import BaseLoop, CheckpointLoader, EpochBasedTrainLoop, Runner
from mmengine.runner import checkpoint as mmengine_checkpoint

from gsmap.checkpoints.convert import summarize_names
from gsmap.checkpoints.published import load_from_file, load_from_torchvision, load_published
from gsmap.checkpoints.reading import refusing
from gsmap.checkpoints.safe_globals import mmengine_globals
from gsmap.checkpoints.settings import IMAGE_SIZE, MODEL_SETTINGS, SIGNALS, plain
from gsmap.checkpoints.unwrapping import unwrap
from gsmap.engine.figures import finish_checks
from gsmap.engine.launch import NEWEST, numbered_checkpoints
from gsmap.engine.optimizers import fit_optimizer_state
from gsmap.engine.random_states import (
    RANDOM_STATES,
    get_random_state,
    resumed_random_state,
    set_random_state,
)
from gsmap.engine.resuming import (
    check_optimizer_state,
    check_readable,
    check_resumable,
    drop_functions,
    fit_schedules,
    ignored_settings,
    refusing_state,
)
from gsmap.engine.run_log import innermost
from gsmap.engine.schedules import check_schedules
from gsmap.utils.errors import InputError, NotFiniteError
from gsmap.utils.files import read_text, remove_link, write_bytes, write_text
from gsmap.utils.model_facts import CALIBRATION, CHECKPOINT, calibration_of
from gsmap.utils.shards import digest
from gsmap.utils.split_lists import (
    SPLIT_LIST,
    TRAINED_ON,
    checked_identity,
    require_same_list,
)
from gsmap.utils.worker_seeds import seed_epoch

VALIDATED = "last_validation"  # file in a work folder: iteration of the latest validation


@register_backend("atomic")
class AtomicLocalBackend(LocalBackend):
    """mmengine's backend for local files, with atomic writes."""

    def put(self, obj: bytes, filepath: str | Path) -> None:
        """Write bytes to a file; a reader opens either the old file or the complete new one."""
        write_bytes(filepath, content=obj)

    def put_text(self, obj: str, filepath: str | Path, encoding: str = "utf-8") -> None:
        """Write text to a file atomically.

        Args:
            obj: Text.
            filepath: File to create or replace.
            encoding: Encoding of the text.
        """
        self.put(obj.encode(encoding), filepath=filepath)


def _metainfo(loader: Any) -> dict[str, Any]:
    """Return the metadata of a loader's data set; empty for data sets without metadata."""
    return getattr(loader.dataset, "metainfo", {})


def _pass_model_facts(loop: Any, path: Path, meta: dict[str, Any]) -> None:
    """Add the checkpoint's digest and calibration to the metadata of the result files.

    Args:
        loop: Test loop, whose evaluator writes the result files.
        path: File or address of the checkpoint.
        meta: Metadata of the checkpoint; untrusted.
    """
    facts: dict[str, Any] = {CALIBRATION: calibration_of(meta)}
    if path.is_file():  # there is no digest of an address
        facts[CHECKPOINT] = digest(path)
    data_facts = loop.evaluator.dataset_meta or {}
    loop.evaluator.dataset_meta = {**data_facts, **facts}


def _resume_sampler_seed(runner: Runner, seed: int | None) -> None:
    """Let the sampler of a resumed training go on with the seed of the checkpoint.

    mmengine restores the seed of the run, which the sampler has got before. A sampler with another
    seed from the config keeps it.

    Args:
        runner: The resumed run, with the seed that it began with.
        seed: Seed of the checkpoint; None if unknown.
    """
    loader = runner.train_dataloader
    # A batch sampler from the config contains the sampler, which the loader then lacks.
    samplers: list[Any] = [loader.sampler, getattr(loader.batch_sampler, "sampler", None)]
    for sampler in samplers:
        if seed is not None and getattr(sampler, "seed", None) == runner.seed:
            sampler.seed = seed


def _require_equal_starts(runner: Runner) -> None:
    """Require that all ranks begin at one iteration, from checkpoints of one name.

    Raises:
        ValueError: If they do not. The gradients would be means over different models.
    """
    source = Path(str(runner._load_from)).name if runner._load_from else "no checkpoint"
    starts = all_gather_object(f"iteration {runner.iter} ({source})")
    for rank, start in enumerate(starts):
        if start != starts[0]:
            raise InputError(
                f"rank 0 begins at {starts[0]}, but rank {rank} at {start}: {runner.work_dir} must "
                "be one folder for all machines, and show them the same files; --resume CHECKPOINT "
                "names one for all."
            )


def _described_datasets(runner: Runner) -> list[Any]:
    """Return the training data sets that know their image size and their signals."""
    datasets = innermost(runner.train_dataloader.dataset)
    return [dataset for dataset in datasets if hasattr(dataset, "scaled_image_size")]


def _image_sizes(datasets: list[Any]) -> set[tuple[int, int]]:
    """Return the sizes of the scaled images; none for data sets without images."""
    sizes = {dataset.scaled_image_size() for dataset in datasets}
    return sizes - {None}


def _image_facts(runner: Runner) -> dict[str, Any]:
    """Return the size of the scaled training images, and whether some samples have signals.

    There is no size if the training data sets have several ones, or no images.
    """
    datasets = _described_datasets(runner)
    sizes = _image_sizes(datasets)
    facts: dict[str, Any] = {}
    if len(sizes) == 1:
        facts[IMAGE_SIZE] = list(sizes.pop())
    if datasets:
        facts[SIGNALS] = any(dataset.has_signals() for dataset in datasets)
    return facts


def _warn_of_differences(runner: Runner) -> None:
    """Log a warning if the training data sets differ in facts that the checkpoints store."""
    datasets = _described_datasets(runner)
    sizes = _image_sizes(datasets)
    if len(sizes) > 1:
        texts = [f"{width} x {height}" for width, height in sorted(sizes)]
        runner.logger.warning(
            f"The training data sets have scaled images of {' and '.join(texts)} pixels, so the "
            "checkpoints store no size, and inference scales images as its config says."
        )
    have_signals = {dataset.has_signals() for dataset in datasets}
    if len(have_signals) > 1:
        runner.logger.warning(
            "Some training data sets have vehicle signals and others have none: inference will "
            "compute missing signals from the poses."
        )


def _warn_of_earlier_run(runner: Runner) -> None:
    """Log a warning if the work folder of a new run has checkpoints."""
    names = sorted(path.name for path in numbered_checkpoints(work_dir=runner.work_dir))
    if names:
        runner.logger.warning(
            f"{runner.work_dir} has checkpoints of an earlier run ({summarize_names(names)}), "
            "which this new run replaces in turn; --resume would continue the earlier run."
        )


@HOOKS.register_module()
class AtomicCheckpointHook(CheckpointHook):
    """mmengine's checkpoint hook, made safe for killed runs and for untrusted checkpoints.

    A run that is killed during a save keeps its previous checkpoint, so ``--resume`` always finds a
    complete one. A validation that was due when the run stopped is run first on resumption. A
    resumed run goes on with the random numbers of the stopped one, and validations do not change
    them. The random numbers of the loader's workers depend on the epoch; in a training by
    iterations they begin anew on resumption. Each checkpoint contains the settings of its model.
    Checkpoints are loaded with torch's ``weights_only``. When a run begins, the hook allows torch
    to load the classes that mmengine stores in a checkpoint.

    By default, validation or test data from another split than the training data raise
    ``ValueError``, because the model may have been trained on the places that they show.

    Args:
        backend_args: Arguments of the file backend, by default atomic writes to local files.
        allow_other_split: Whether validation and test data may come from another split than the
            training data.
        *args: Positional arguments of ``CheckpointHook``.
        **kwargs: Keyword arguments of ``CheckpointHook``.
    """

    def __init__(
        self,
        *args: Any,
        backend_args: dict | None = None,
        allow_other_split: bool = False,
        **kwargs: Any,
    ) -> None:
        super().__init__(*args, backend_args=backend_args or {"backend": "atomic"}, **kwargs)
        self.allow_other_split = allow_other_split
        # States of the random number generators of this process, see `get_random_state`
        self._resumed_state: dict[str, Any] | None = None  # to set when the training goes on
        self._state_before_val: dict[str, Any] | None = None  # None outside of a validation
        self._saved_states: list[dict[str, Any]] | None = None  # of all ranks, during a save
        self._has_saved = False
        self._saved_iter: int | None = None  # iteration of the checkpoint that the run goes on from

    def before_run(self, runner: Runner) -> None:
        """Register the safe checkpoint loaders; mmengine loads a checkpoint after this call."""
        # mmengine's loader of web addresses calls `load_url`. The loaders of torchvision's weights
        # and of local paths (the empty scheme) are replaced in the registry.
        mmengine_checkpoint.load_url = load_published
        CheckpointLoader.register_scheme(
            ("torchvision://", "modelzoo://"), loader=load_from_torchvision, force=True
        )
        CheckpointLoader.register_scheme("", loader=load_from_file, force=True)
        torch.serialization.add_safe_globals(mmengine_globals())

    def after_load_checkpoint(self, runner: Runner, checkpoint: dict) -> None:
        """Check a loaded checkpoint, and adapt it to the run in place.

        The config text, which mmengine would execute, is removed. Weights that other training loops
        stored elsewhere are moved to ``state_dict``. On resumption, the optimizer state is
        converted to the parameter groups of this run, and settings of the run that it replaces are
        logged. The split of the checkpoint is passed to the validation and test loops, and its
        calibration to the test loop.

        Raises:
            ValueError: If the run cannot be resumed from the checkpoint, if the checkpoint has no
                usable weights, if its metadata are invalid, or if it was trained on another split.
        """
        source = runner._load_from  # file or address of the checkpoint
        if runner._resume:
            check_resumable(checkpoint, runner=runner, path=source)
        with refusing(path=source):  # errors name the source and a remedy
            state = unwrap(checkpoint).state  # weights, with the keys of an unwrapped model
        # Other training loops store the weights elsewhere, or below a prefix.
        if state.keys() != checkpoint.get("state_dict", {}).keys():
            checkpoint["state_dict"] = state
        meta = checkpoint.get("meta")
        if not isinstance(meta, dict):
            meta = {}
        meta.pop("config", None)
        if runner._resume:
            self._fit_to_run(runner, checkpoint=checkpoint, meta=meta)
        trained_meta = meta.get("dataset_meta")
        if isinstance(trained_meta, dict):
            # A loop is None if the run does not have it, or a dict if mmengine has not built it.
            for loop in (runner._val_loop, runner._test_loop):
                if isinstance(loop, BaseLoop):
                    self._check_split(trained_meta, loop=loop)
        if isinstance(runner._test_loop, BaseLoop):
            _pass_model_facts(runner._test_loop, path=Path(str(source)), meta=meta)

    def _fit_to_run(self, runner: Runner, checkpoint: dict[str, Any], meta: dict[str, Any]) -> None:
        """Adapt the progress, the schedules and the optimizer state of a checkpoint, in place.

        Args:
            runner: The resumed run.
            checkpoint: The checkpoint.
            meta: Metadata of the checkpoint.
        """
        _resume_sampler_seed(runner, seed=meta.get("seed"))
        self._resume_iterations(runner, checkpoint=checkpoint, meta=meta)
        if "optimizer" in checkpoint:
            self._fit_optimizer(runner, checkpoint=checkpoint)
        self._resumed_state = resumed_random_state(checkpoint=checkpoint, runner=runner)

    def _resume_iterations(
        self, runner: Runner, checkpoint: dict[str, Any], meta: dict[str, Any]
    ) -> None:
        """Convert the number of iterations of a checkpoint to the length of this run's epochs.

        Epochs have another length with another batch size, data set or number of processes.

        Args:
            runner: The resumed run.
            checkpoint: The checkpoint, whose schedules are converted in place, too.
            meta: Metadata of the checkpoint, converted in place.
        """
        self._saved_iter = meta["iter"]
        loop = runner.train_loop
        if not isinstance(loop, EpochBasedTrainLoop):
            return
        iterations = meta["epoch"] * len(loop.dataloader)
        if iterations != meta["iter"]:
            runner.logger.warning(
                f"{runner._load_from} was saved after {meta['iter']} iterations, and this run has "
                f"{len(loop.dataloader)} in each epoch (another batch size, data set or number of "
                f"processes), so it goes on after iteration {iterations}."
            )
            fit_schedules(
                checkpoint, runner.cfg.get("param_scheduler"), iterations / max(meta["iter"], 1)
            )
            meta["iter"] = iterations

    def _fit_optimizer(self, runner: Runner, checkpoint: dict) -> None:
        """Convert the optimizer state of a checkpoint to the parameter groups of a resumed run.

        Raises:
            ValueError: If the state does not fit the run.
        """
        source = runner._load_from
        wrapper = runner.optim_wrapper
        # The check needs the parameter groups of this run, so it follows the conversion.
        fit_optimizer_state(checkpoint, wrapper=wrapper)
        if isinstance(wrapper, OptimWrapper):  # a dict of wrappers has several optimizers
            with refusing_state(path=source):  # a malformed state becomes a ValueError
                check_optimizer_state(
                    checkpoint["optimizer"], optimizer=wrapper.optimizer, path=source
                )
        ignored = ignored_settings(checkpoint, runner=runner)
        if ignored:
            runner.logger.warning(
                f"The training goes on with the settings of {source}: {', '.join(ignored)}. For "
                "those of the config, start a new one from its weights (--work-dir NEW "
                f"--cfg-options load_from={source})."
            )

    def before_save_checkpoint(self, runner: Runner, checkpoint: dict) -> None:
        """Store the model's settings, the size of the scaled images and the presence of signals.

        Functions are removed from the states of the schedulers, because loading refuses them.

        Raises:
            FloatingPointError: If a loss or a weight is not finite.
            ValueError: If the first checkpoint of a run has entries that loading would refuse.
        """
        finish_checks(runner)  # raises the error of a loss that was not finite
        nonfinite_keys = []
        for key, value in checkpoint["state_dict"].items():
            if not bool(value.isfinite().all()):
                nonfinite_keys.append(key)
        if nonfinite_keys:
            raise NotFiniteError(
                f"weights are NaN or infinite ({summarize_names(nonfinite_keys)}), so they are not "
                "saved."
            )
        settings = plain(runner.cfg.model.to_dict())  # JSON types only
        checkpoint["meta"][MODEL_SETTINGS] = json.dumps(settings)
        checkpoint["meta"].update(_image_facts(runner))
        if self._saved_states is not None:
            checkpoint[RANDOM_STATES] = self._saved_states
        drop_functions(checkpoint=checkpoint)
        if not self._has_saved:
            check_readable(checkpoint=checkpoint)
            self._has_saved = True

    def _save_checkpoint_with_step(self, runner: Runner, step: int, meta: dict) -> None:
        """Save a checkpoint, and write its path to the file `NEWEST`.

        mmengine would follow a link of this name and overwrite its target, so a link is removed.
        """
        if runner.rank == 0:
            remove_link(Path(runner.work_dir, NEWEST))
        # A better validation saves the checkpoint once more.
        state = self._state_before_val or get_random_state()
        self._saved_states = all_gather_object(state)
        super()._save_checkpoint_with_step(runner, step=step, meta=meta)
        self._saved_states = None

    def _check_split(self, trained_meta: dict[str, Any], loop: Any) -> None:
        """Require that evaluation data come from the training's split, and record it for results.

        If the data sets differ, nothing is checked or recorded. An unknown split is accepted.

        Args:
            trained_meta: Metadata of the training's data set; untrusted if from a checkpoint.
            loop: Validation or test loop.

        Raises:
            ValueError: If both splits are known and differ, unless ``allow_other_split`` is set, or
                if the identity of a split is malformed.
        """
        scored_meta = _metainfo(loop.dataloader)
        if trained_meta.get("dataset") != scored_meta.get("dataset"):
            return
        identity = checked_identity(trained_meta.get(SPLIT_LIST))  # empty if unknown
        if not self.allow_other_split:
            require_same_list(
                model=identity,
                data=scored_meta.get(SPLIT_LIST),
                subject="the model",
                remedy="--cfg-options default_hooks.checkpoint.allow_other_split=True",
            )
        known_facts = loop.evaluator.dataset_meta or {}
        loop.evaluator.dataset_meta = {**known_facts, **scored_meta, TRAINED_ON: identity}

    def before_train(self, runner: Runner) -> None:
        """Prepare the training, and run a validation that was due when the run was interrupted.

        Raises:
            ValueError: If the validation data are from another split than the training data, the
                ranks begin differently, or a schedule over iterations does not fit the training.
        """
        # `check_config` does not know how many iterations the epochs of a data set have.
        check_schedules(runner.cfg, iterations=runner.max_iters)
        _require_equal_starts(runner)
        super().before_train(runner)  # restores the paths of the best checkpoints when resuming
        self._forget_foreign_best(runner)
        _warn_of_differences(runner)
        if not runner._resume:
            _warn_of_earlier_run(runner=runner)
        if isinstance(runner.val_loop, BaseLoop):
            self._check_split(_metainfo(runner.train_dataloader), loop=runner.val_loop)
        loop = runner.train_loop
        if isinstance(loop, EpochBasedTrainLoop):
            progress = loop.epoch
            end = loop.max_epochs
        else:
            progress = loop.iter
            end = loop.max_iters
        # mmengine's conditions for a validation, applied to the progress at which the run stopped.
        # Progress 0 is a new run.
        has_begun = progress >= max(loop.val_begin, 1)
        is_at_interval = progress % loop.val_interval == 0 or progress == end
        is_due = has_begun and is_at_interval
        marker = Path(runner.work_dir, VALIDATED)
        saved_iter = runner.iter if self._saved_iter is None else self._saved_iter
        is_validated = [marker.exists() and read_text(marker) == str(saved_iter)]
        broadcast_object_list(is_validated)  # the first rank has written the file
        if is_due and runner.val_loop is not None and not is_validated[0]:
            runner.logger.info("The run was cut off before its validation, which is run now.")
            runner.val_loop.run()

    def before_train_epoch(self, runner: Runner) -> None:
        """Seed the loader's workers, and go on with the random numbers of the stopped run.

        Starting the workers takes a random number. Persistent workers start after this call, in
        the first epoch alone, so the random numbers are set in `before_train_iter`. So they are in
        a training by iterations, whose workers have started before this call.
        """
        if not isinstance(runner.train_loop, EpochBasedTrainLoop):
            return
        loader = runner.train_dataloader
        if getattr(loader, "num_workers", 0):
            seed_epoch(loader, seed=runner.seed, epoch=runner.epoch, rank=runner.rank)
        if not getattr(loader, "persistent_workers", False):
            self._continue_random_numbers()

    def before_train_iter(self, runner: Runner, batch_idx: int, data_batch: Any = None) -> None:
        """Go on with the random numbers of the stopped run, before the first iteration.

        Args:
            runner: The training.
            batch_idx: Index of the batch in its epoch.
            data_batch: The batch.
        """
        self._continue_random_numbers()

    def _continue_random_numbers(self) -> None:
        """Set the state that the checkpoint has, once."""
        if self._resumed_state is not None:
            set_random_state(state=self._resumed_state)
            self._resumed_state = None

    def before_val(self, runner: Runner) -> None:
        """Keep the state of the random numbers during a validation."""
        self._state_before_val = get_random_state()

    def after_val(self, runner: Runner) -> None:
        """Go on with the random numbers as if there had been no validation."""
        if self._state_before_val is not None:
            set_random_state(state=self._state_before_val)
            self._state_before_val = None

    def _forget_foreign_best(self, runner: Runner) -> None:
        """Forget best checkpoints outside of the run's folder, which mmengine might delete."""
        folder = Path(self.out_dir).resolve()
        # mmengine has `best_ckpt_path` for one metric in `save_best` and `best_ckpt_path_dict` for
        # several ones. Without `save_best` there may be neither.
        if self._is_foreign(getattr(self, "best_ckpt_path", None), folder=folder):
            self.best_ckpt_path = None
        paths = getattr(self, "best_ckpt_path_dict", {})
        for name, path in paths.items():
            if self._is_foreign(path, folder=folder):
                paths[name] = None

    def _forget_other_best(self, runner: Runner, name: str) -> None:
        """Forget the best score of a resumed run if it is of another metric than a given one.

        mmengine stores the score of a single metric without its name, which is in the file's name.
        """
        info = runner.message_hub.runtime_info
        if "best_score" not in info:
            return
        best = Path(str(info.get("best_ckpt"))).name
        prefix = f"best_{name}_".replace("/", "_")
        if re.fullmatch(rf"{re.escape(prefix)}(epoch|iter)_\d+\.pth", best):
            return
        runner.logger.warning(
            f"{best!r:.80} is of another metric than save_best ({name}): it stays, and this run "
            "looks for its best from now on."
        )
        del info["best_score"]
        info.pop("best_ckpt", None)  # mmengine removes the best checkpoint for a better one
        self.best_ckpt_path = None

    @staticmethod
    def _is_foreign(path: Any, folder: Path) -> bool:
        """Whether a path from a checkpoint is not a best checkpoint in the run's folder."""
        if path is None:  # no best checkpoint yet
            return False
        if not isinstance(path, str):
            return True
        best_path = Path(path)
        has_best_name = re.fullmatch(r"best_.+_\d+\.pth", best_path.name)
        return not has_best_name or best_path.is_symlink() or best_path.resolve().parent != folder

    def after_val_epoch(self, runner: Runner, metrics: dict[str, float] | None = None) -> None:
        """Save the best checkpoint, and record the validated iteration.

        Raises:
            ValueError: If the validation lacks the metric that ``save_best`` names.
        """
        names = getattr(self, "key_indicators", [])  # metrics in `save_best`, if it is set
        for name in names:
            # mmengine replaces "auto" by the first metric.
            if metrics and name not in metrics and name != "auto":
                mean_names = [metric for metric in metrics if metric.endswith("/mAP")]
                raise InputError(
                    f"default_hooks.checkpoint.save_best names {name!r}, which the validation does "
                    f"not measure; it measures {', '.join(mean_names or metrics)}."
                )
        if metrics and len(names) == 1:
            name = next(iter(metrics)) if names[0] == "auto" else names[0]
            self._forget_other_best(runner, name=name)
        super().after_val_epoch(runner, metrics=metrics)
        if runner.rank == 0:
            write_text(Path(runner.work_dir, VALIDATED), text=str(runner.iter))
