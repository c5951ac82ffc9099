"""What trainings of tests have in their config so that they wait for the test, not for a time.

A config names it: ``custom_imports = dict(imports=['gsmap.registered', 'waiting'])``.
"""

import time
from pathlib import Path

from mmengine.hooks import Hook
from mmengine.registry import HOOKS

from gsmap.engine import rank_watch

LEAF = """
_base_ = '{config}'
custom_imports = dict(imports=['gsmap.registered', 'waiting'])
default_hooks = dict(waits=dict(type='WaitsWhile', file='{file}', priority='LOWEST'))
"""


def waiting_config(config: Path, folder: Path) -> tuple[Path, Path]:
    """Write a config whose training waits after each epoch's checkpoint while a file is there.

    Args:
        config: The config that it is based on, whose name it has.
        folder: Where to write it.

    Returns:
        The config, and the file, which is there.
    """
    file = folder / "wait"
    file.touch()
    leaf = folder / config.name
    leaf.write_text(LEAF.format(config=config, file=file))
    return leaf, file


@HOOKS.register_module()
class WaitsWhile(Hook):
    """Waits after each epoch while a file is there."""

    def __init__(self, file: str) -> None:
        self._file = Path(file)

    def after_train_epoch(self, runner):
        while self._file.exists():
            time.sleep(0.02)


@HOOKS.register_module()
class LooksEarly(Hook):
    """Has a rank look for silent ones long before an operation of all ranks times out.

    After the first epoch: kernels are compiled in it, which takes a minute the first time.
    """

    def after_train_epoch(self, runner):
        rank_watch._PATIENCE = 0.1
