#!/usr/bin/env python
"""Train a model: ``python tools/train.py CONFIG``."""

# Imported before all libraries: this handles Ctrl-C during their imports, and keeps them from
# reading settings files in the working folder.
import gsmap  # noqa: F401

# isort: split
import argparse
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

from mmengine.config import Config

from gsmap.checkpoints.named_models import find_checkpoint
from gsmap.engine.arguments import add_common_arguments
from gsmap.utils.cli import CommandParser, run_command
from gsmap.utils.errors import InputError
from gsmap.utils.files import lock_folder
from gsmap.utils.interrupt import is_first_rank


def parse_args() -> argparse.Namespace:
    parser = CommandParser(description=__doc__)
    parser.add_argument("config", help="config: its file or its name")
    parser.add_argument(
        "--resume",
        nargs="?",
        const="auto",
        help="continue from this checkpoint, or from the newest complete one in the work folder",
    )
    parser.add_argument("--amp", action="store_true", help="train with automatic mixed precision")
    parser.add_argument(
        "--auto-scale-lr",
        action="store_true",
        help="scale the learning rate from the config's base batch size to the actual one",
    )
    parser.add_argument(
        "--overfit",
        type=int,
        metavar="N",
        help="train on the first N samples alone, without validation, into work_dirs/NAME_overfit",
    )
    parser.add_argument(
        "--overfit-iterations",
        type=int,
        default=300,
        metavar="M",
        help="length of such a training (default: %(default)s)",
    )
    add_common_arguments(parser)
    return parser.parse_args()


def choose_start(cfg: Config, resume: str | None) -> None:
    """Set and check the checkpoint from which the run resumes or takes its initial weights.

    Args:
        cfg: Config of the run, changed in place. ``load_from`` becomes the checkpoint. ``resume``
            becomes True if the run continues with the optimizer and the number of iterations in
            the checkpoint, and False if it takes only the weights.
        resume: Value of ``--resume``: a checkpoint; ``auto`` for the newest one in the work folder,
            if there is one; or None for the settings of the config: ``load_from`` is the checkpoint
            to resume from if ``resume`` is True, and otherwise has the weights to start from.

    Raises:
        FileNotFoundError: If the checkpoint does not exist.
        ValueError: If the checkpoint cannot be loaded, or a new training would start from a
            checkpoint in its work folder, which it would replace.
    """
    from gsmap.checkpoints.reading import read_weights
    from gsmap.engine.launch import newest_checkpoint

    if resume is None and cfg.get("resume"):
        resume = cfg.get("load_from") or "auto"
    if resume == "auto":
        newest = newest_checkpoint(cfg.work_dir, read_weights)  # skips files that cannot be read
        if newest is None and is_first_rank():
            print(f"{cfg.work_dir} holds no checkpoint: the run starts at its beginning.")
        resume = None if newest is None else str(newest)
    cfg.resume = resume is not None
    cfg.load_from = resume or cfg.get("load_from")
    # A URL is not checked here, because only the runner downloads it. Any other value is a file or
    # the name of a model, which `find_checkpoint` replaces by the path of the model's file.
    if cfg.load_from and "://" not in str(cfg.load_from):
        cfg.load_from = str(find_checkpoint(cfg.load_from))
        read_weights(cfg.load_from)  # raises an error for a file that cannot be loaded
        if not cfg.resume and Path(cfg.load_from).resolve().parent == Path(cfg.work_dir).resolve():
            raise InputError(
                f"{cfg.load_from}, from which this run is to start, lies in its work folder, and "
                "the run would replace the checkpoints there: give another --work-dir, or --resume."
            )


def check_scaling(cfg: Config, runner_type: type) -> None:
    """Require a runner that counts accumulated gradients where it scales the learning rate.

    Args:
        cfg: Config of the run.
        runner_type: Class of the runner.

    Raises:
        ValueError: If another runner than GSMap's would scale for the batch size of an iteration.
    """
    from gsmap.engine.run_log import MapRunner

    is_scaled = (cfg.get("auto_scale_lr") or {}).get("enable", False)
    iterations = (cfg.get("optim_wrapper") or {}).get("accumulative_counts", 1)
    if is_scaled and iterations != 1 and not issubclass(runner_type, MapRunner):
        raise InputError(
            f"{cfg.filename}: auto_scale_lr of {runner_type.__name__} would not count that "
            f"optim_wrapper.accumulative_counts is {iterations}: leave out runner_type, or set "
            "optim_wrapper.optimizer.lr in place of auto_scale_lr."
        )


def lock_work_dir(work_dir: str) -> AbstractContextManager:
    """Lock the work folder for this run. The first rank locks it for all ranks.

    Returns:
        Context manager that unlocks the folder at its end; without effect in other ranks.

    Raises:
        RuntimeError: If another run has locked the folder.
        ValueError: If another program has written the lock file.
    """
    if not is_first_rank():
        return nullcontext()
    advice = "wait for its end, or give another --work-dir"
    return lock_folder(Path(work_dir), ".training", advice=advice)


def main() -> None:
    args = parse_args()
    # Imported after the options are parsed, because these imports are slow.
    import torch
    from mmdet3d.registry import RUNNERS

    from gsmap.checkpoints.building import building
    from gsmap.engine.launch import load_config
    from gsmap.engine.optimizers import use_mixed_precision
    from gsmap.engine.overfitting import overfit
    from gsmap.engine.run_log import MapRunner

    if args.overfit is not None and not args.work_dir:
        args.work_dir = str(Path("work_dirs") / f"{Path(args.config).stem}_overfit")
    cfg = load_config(args)
    if args.overfit is not None:
        # This changes the config in place.
        overfit(cfg, samples=args.overfit, iterations=args.overfit_iterations)
    if args.amp:
        use_mixed_precision(cfg.optim_wrapper, on_gpu=torch.cuda.is_available())
    if args.auto_scale_lr:
        if "base_batch_size" not in cfg.get("auto_scale_lr", {}):
            raise InputError(f"{args.config} names no auto_scale_lr.base_batch_size to scale from.")
        cfg.auto_scale_lr.enable = True
    # As in mmengine's tools, a config may name another class of runners.
    runner_type = RUNNERS.get(cfg.runner_type) if "runner_type" in cfg else MapRunner
    check_scaling(cfg, runner_type)
    # Locked before the checkpoint is chosen, so that no other run writes checkpoints meanwhile.
    with lock_work_dir(cfg.work_dir):
        choose_start(cfg, args.resume)
        with building(cfg):  # adds the names of the config and of its parts to errors
            runner = runner_type.from_cfg(cfg)
            runner.train()


if __name__ == "__main__":
    # After ``kill``, a rank ends at once: its clean-up would wait for the other ranks.
    run_command(main, clean_up_on_kill=False)
