"""Shared command-line arguments.

Neither this module nor ``mmengine.config`` imports torch, which keeps ``--help`` fast.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mmengine.config import DictAction


class OverrideAction(DictAction):
    """Store overrides ``KEY=VALUE`` in a dictionary, with a message if one cannot be parsed."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        """Add the overrides to the dictionary in the namespace."""
        for value in values:
            try:
                super().__call__(parser, namespace, [value], option_string)
            except (AssertionError, RecursionError, ValueError) as error:  # mmengine's
                raise argparse.ArgumentError(
                    self,
                    f"{value!r} is no KEY=VALUE with closed brackets, such as KEY=[1,2]; override "
                    "the settings of a dictionary one by one, by KEY.NAME=VALUE",
                ) from error


class _OptionAction(argparse.Action):
    """Store ``--data-root`` or ``--image-scale`` and add it to the config overrides.

    Overrides from ``--cfg-options`` take precedence, in any order of the options. If they come
    first, this action keeps them. If they come later, their action (`OverrideAction`) extends
    the overrides and replaces the values of equal keys.
    """

    def __call__(
        self, parser: object, namespace: argparse.Namespace, values: Any, option: object = None
    ) -> None:
        earlier_overrides = dict(getattr(namespace, "cfg_options", None) or {})
        earlier_value = getattr(namespace, self.dest, None)
        # If the option is given twice, the last value counts.
        if earlier_value is not None and earlier_overrides.get(self.dest) == earlier_value:
            del earlier_overrides[self.dest]
        setattr(namespace, self.dest, values)
        # `read_config` applies these two overrides to all splits.
        namespace.cfg_options = {self.dest: values, **earlier_overrides}


def add_config_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that override config settings.

    The parser stores all overrides, by dotted name, in ``cfg_options``. It is None without any.
    """
    parser.add_argument(
        "--data-root",
        type=Path,
        metavar="DIR",
        action=_OptionAction,
        help="folder with the annotation files of the data set; paths in them are relative to it",
    )
    parser.add_argument(
        "--image-scale",
        type=float,
        metavar="FACTOR",
        action=_OptionAction,
        help="scale of the images; default: to the size of the training images",
    )
    parser.add_argument(
        "--cfg-options",
        nargs="+",
        action=OverrideAction,
        metavar="KEY=VALUE",
        help="override settings, e.g. train_dataloader.batch_size=2",
    )


def parse_options(words: Sequence[str]) -> dict[str, Any]:
    """Parse overrides of the form ``KEY=VALUE`` as ``--cfg-options`` does.

    Returns:
        Value of each setting, by its dotted name.
    """
    parser = argparse.ArgumentParser()
    add_config_options(parser)
    return parser.parse_args(["--cfg-options", *words]).cfg_options


def add_common_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of training and testing.

    These are options that OpenMMLab's tools have, too, and `add_config_options`. PyTorch's launcher
    passes ``--local_rank``, the number of the process on its machine.
    """
    parser.add_argument("--work-dir", help="folder for logs, checkpoints and pictures")
    add_config_options(parser)
    parser.add_argument("--launcher", choices=["none", "pytorch", "slurm", "mpi"], default="none")
    parser.add_argument("--local_rank", "--local-rank", type=int, default=0)
