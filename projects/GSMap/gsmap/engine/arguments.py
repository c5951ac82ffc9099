"""Arguments that the commands share, without torch, so that ``--help`` is quick."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mmengine.config import DictAction


def data_root_options(data_root: str | Path) -> dict[str, str]:
    """Return the overrides, by dotted name, that take every split from one folder."""
    splits = ("train", "val", "test")
    return {f"{split}_dataloader.dataset.data_root": str(data_root) for split in splits}


class _DataRootAction(argparse.Action):
    """Turns ``--data-root DIR`` into overrides, which those of ``--cfg-options`` outdo."""

    def __call__(
        self, parser: object, namespace: argparse.Namespace, values: Any, option: object = None
    ) -> None:
        namespace.data_root = values
        given = getattr(namespace, "cfg_options", None) or {}
        namespace.cfg_options = {**data_root_options(values), **given}


def add_config_options(parser: argparse.ArgumentParser) -> None:
    """Add ``--data-root`` and ``--cfg-options``; both go to `read_config` as ``cfg_options``."""
    parser.add_argument(
        "--data-root",
        type=Path,
        metavar="DIR",
        action=_DataRootAction,
        help="folder of the data set: annotation files, and root of the paths in them",
    )
    parser.add_argument(
        "--cfg-options",
        nargs="+",
        action=DictAction,
        metavar="KEY=VALUE",
        help="override settings, e.g. train_dataloader.batch_size=2",
    )


def parse_options(words: Sequence[str]) -> dict[str, Any]:
    """Read overrides ``KEY=VALUE`` as ``--cfg-options`` does."""
    parser = argparse.ArgumentParser()
    add_config_options(parser)
    return parser.parse_args(["--cfg-options", *words]).cfg_options


def add_common_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options that every OpenMMLab tool has."""
    parser.add_argument("--work-dir", help="folder for logs, checkpoints and pictures")
    add_config_options(parser)
    parser.add_argument("--launcher", choices=["none", "pytorch", "slurm", "mpi"], default="none")
    parser.add_argument("--local_rank", "--local-rank", type=int, default=0)
