"""Checkpoints that are whole or absent when written, and run no code when read."""

import json
import re
from pathlib import Path
from typing import Any

import torch
from mmdet3d.registry import HOOKS
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
from gsmap.engine.optimizers import fit_optimizer_state
from gsmap.engine.resuming import check_optimizer_state, check_resumable, refusing_state
from gsmap.engine.run_log import innermost
from gsmap.utils.errors import InputError, NotFiniteError
from gsmap.utils.files import read_text, take_from_link, write_bytes, write_text
from gsmap.utils.model_facts import CALIBRATION, CHECKPOINT, calibration_of
from gsmap.utils.shards import digest
from gsmap.utils.split_lists import (
    SPLIT_LIST,
    TRAINED_ON,
    checked_identity,
    require_same_list,
)

NEWEST = "last_checkpoint"  # file of a work folder, which mmengine opens as it stands
VALIDATED = "last_validation"  # file of a work folder: the iteration validated last


@register_backend("atomic")
class AtomicLocalBackend(LocalBackend):
    """mmengine's local files, each written beside its place and then moved there in one step."""

    def put(self, obj: bytes, filepath: str | Path) -> None:
        """Write ``obj`` to ``filepath``; a reader sees the old file or the whole new one."""
        write_bytes(filepath, obj)

    def put_text(self, obj: str, filepath: str | Path, encoding: str = "utf-8") -> None:
        """Write text to ``filepath`` in one step."""
        self.put(obj.encode(encoding), filepath)


def _metainfo(loader: Any) -> dict[str, Any]:
    """Return what a data set says of itself; nothing if it is none of mmengine's."""
    return getattr(loader.dataset, "metainfo", {})


def _tell_results(loop: Any, path: Path, meta: dict[str, Any]) -> None:
    """Tell what writes results which checkpoint they are of, and how that was calibrated."""
    facts: dict[str, Any] = {CALIBRATION: calibration_of(meta)}
    if path.is_file():  # not an address
        facts[CHECKPOINT] = digest(path)
    loop.evaluator.dataset_meta = {**(loop.evaluator.dataset_meta or {}), **facts}


@HOOKS.register_module()
class AtomicCheckpointHook(CheckpointHook):
    """mmengine's hook, for runs that may be killed and for checkpoints from strangers.

    A run that is killed while it saves leaves the previous checkpoint as it was, so ``--resume``
    always finds a whole one, and a validation that it missed is made up for on resuming. A
    checkpoint holds the model's settings. What is loaded, fetched and resumed from is read with
    torch's ``weights_only``, to which the hook names mmengine's own data when a run begins.

    Data to score of another split than a model is or was trained on is refused (``ValueError``),
    unless ``allow_other_split``: the training may hold its places.
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

    def before_run(self, runner: Runner) -> None:
        """Let torch read mmengine's checkpoints; mmengine reads one right after this."""
        mmengine_checkpoint.load_url = load_published
        register = CheckpointLoader.register_scheme
        register(("torchvision://", "modelzoo://"), load_from_torchvision, force=True)
        register("", load_from_file, force=True)
        torch.serialization.add_safe_globals(mmengine_globals())

    def after_load_checkpoint(self, runner: Runner, checkpoint: dict) -> None:
        """Drop the text that mmengine would run as a config; check and note the model's origin.

        Weights that another training loop wrapped are put where mmengine looks for them. Of a run
        that goes on, the optimizer's state is fitted to its groups of parameters.

        Raises:
            ValueError: If the run cannot go on from it, or it is of another split.
        """
        if runner._resume:
            check_resumable(checkpoint, runner, runner._load_from)
        with refusing(runner._load_from):
            state = unwrap(checkpoint).state
        if state.keys() != checkpoint.get("state_dict", {}).keys():
            checkpoint["state_dict"] = state
        meta = checkpoint.get("meta")
        meta = meta if isinstance(meta, dict) else {}
        meta.pop("config", None)
        if "optimizer" in checkpoint and runner._resume:
            wrapper = runner.optim_wrapper
            fit_optimizer_state(checkpoint, wrapper)
            if isinstance(wrapper, OptimWrapper):
                path = runner._load_from
                with refusing_state(path):
                    check_optimizer_state(checkpoint["optimizer"], wrapper.optimizer, path=path)
        trained = meta.get("dataset_meta")
        for loop in (runner._val_loop, runner._test_loop):
            if isinstance(loop, BaseLoop) and isinstance(trained, dict):
                self._check_split(trained, loop)
        if isinstance(runner._test_loop, BaseLoop):
            _tell_results(runner._test_loop, Path(str(runner._load_from)), meta)

    def before_save_checkpoint(self, runner: Runner, checkpoint: dict) -> None:
        """Note the model's settings, the size of the scaled images, and if there are signals.

        Raises:
            FloatingPointError: If a loss or a weight is not finite; such a checkpoint is of no use.
        """
        finish_checks(runner)
        state = checkpoint["state_dict"]
        broken = [key for key, value in state.items() if not bool(value.isfinite().all())]
        if broken:
            raise NotFiniteError(
                f"weights are NaN or infinite ({summarize_names(broken)}), so they are not saved."
            )
        settings = plain(runner.cfg.model.to_dict())
        checkpoint["meta"][MODEL_SETTINGS] = json.dumps(settings)
        dataset = innermost(runner.train_dataloader.dataset)
        if hasattr(dataset, "scaled_image_size"):
            checkpoint["meta"][IMAGE_SIZE] = list(dataset.scaled_image_size())
            checkpoint["meta"][SIGNALS] = dataset.has_signals()

    def _save_checkpoint_with_step(self, runner: Runner, step: int, meta: dict) -> None:
        """Save a checkpoint; the file that tells of the newest is never written through a link."""
        if runner.rank == 0:
            take_from_link(Path(runner.work_dir, NEWEST))
        super()._save_checkpoint_with_step(runner, step, meta)

    def _check_split(self, trained: dict[str, Any], loop: Any) -> None:
        """Refuse data of another split, and tell results what the model was trained on."""
        scored = _metainfo(loop.dataloader)
        if trained.get("dataset") != scored.get("dataset"):
            return
        identity = checked_identity(trained.get(SPLIT_LIST))
        if not self.allow_other_split:
            remedy = "--cfg-options default_hooks.checkpoint.allow_other_split=True"
            require_same_list(identity, scored.get(SPLIT_LIST), "the model", remedy)
        loop.evaluator.dataset_meta = scored | {TRAINED_ON: identity}

    def before_train(self, runner: Runner) -> None:
        """Make up for the validation that was due when a run was cut off, then begin as ever."""
        super().before_train(runner)
        self._forget_others_best(runner)
        if isinstance(runner.val_loop, BaseLoop):
            self._check_split(_metainfo(runner.train_dataloader), runner.val_loop)
        loop, marker = runner.train_loop, Path(runner.work_dir, VALIDATED)
        by_epoch = isinstance(loop, EpochBasedTrainLoop)
        done, end = (loop.epoch, loop.max_epochs) if by_epoch else (loop.iter, loop.max_iters)
        due = done >= max(loop.val_begin, 1) and (done % loop.val_interval == 0 or done == end)
        validated = marker.exists() and read_text(marker) == str(runner.iter)
        if due and runner.val_loop is not None and not validated:
            runner.logger.info("The run was cut off before its validation, which is made up for.")
            runner.val_loop.run()

    def _forget_others_best(self, runner: Runner) -> None:
        """Keep mmengine from removing, as the best before, a file that only a checkpoint names."""
        folder = Path(self.out_dir).resolve()
        if self._is_elsewhere(getattr(self, "best_ckpt_path", None), folder):
            self.best_ckpt_path = None
        paths = getattr(self, "best_ckpt_path_dict", {})
        paths.update({name: None for name, p in paths.items() if self._is_elsewhere(p, folder)})

    @staticmethod
    def _is_elsewhere(path: Any, folder: Path) -> bool:
        """Whether a path is none of a best checkpoint of a run's folder."""
        if not isinstance(path, str):
            return path is not None
        place = Path(path)
        name = re.fullmatch(r"best_.+_\d+\.pth", place.name)
        return not name or place.is_symlink() or place.resolve().parent != folder

    def after_val_epoch(self, runner: Runner, metrics: dict[str, float] | None = None) -> None:
        """Keep the best checkpoint and note which state was validated.

        Raises:
            ValueError: If the validation does not have the figure that ``save_best`` names.
        """
        for name in getattr(self, "key_indicators", ()):
            if metrics and name not in metrics:
                raise InputError(
                    f"default_hooks.checkpoint.save_best names {name!r}, which the validation does "
                    f"not measure; it has {', '.join(n for n in metrics if n.endswith('/mAP'))}."
                )
        super().after_val_epoch(runner, metrics)
        if runner.rank == 0:
            write_text(Path(runner.work_dir, VALIDATED), str(runner.iter))
