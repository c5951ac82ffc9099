"""Checkpoints that are whole or absent when written, and run no code when read."""

from pathlib import Path
from typing import Any

import torch
from mmdet3d.registry import HOOKS
from mmengine.fileio import LocalBackend, register_backend
from mmengine.hooks import CheckpointHook
from mmengine.runner import Runner

from gsmap.checkpoints.safe_globals import mmengine_globals
from gsmap.utils.files import write_bytes


@register_backend("atomic")
class AtomicLocalBackend(LocalBackend):
    """mmengine's local files, each written beside its place and then moved there in one step."""

    def put(self, obj: bytes, filepath: str | Path) -> None:
        """Write ``obj`` to ``filepath``; a reader sees the old file or the whole new one."""
        write_bytes(filepath, obj)

    def put_text(self, obj: str, filepath: str | Path, encoding: str = "utf-8") -> None:
        """Write text to ``filepath`` in one step."""
        self.put(obj.encode(encoding), filepath)


@HOOKS.register_module()
class AtomicCheckpointHook(CheckpointHook):
    """mmengine's hook, for runs that may be killed and for checkpoints from strangers.

    A run that is killed while it saves leaves the previous checkpoint as it was, so ``--resume``
    always finds a whole one. What is loaded and resumed from is read with torch's ``weights_only``,
    to which the hook names mmengine's own data when a run begins.
    """

    def __init__(self, *args: Any, backend_args: dict | None = None, **kwargs: Any) -> None:
        super().__init__(*args, backend_args=backend_args or {"backend": "atomic"}, **kwargs)

    def before_run(self, runner: Runner) -> None:
        """Let torch read mmengine's checkpoints; mmengine reads one right after this."""
        torch.serialization.add_safe_globals(mmengine_globals())
