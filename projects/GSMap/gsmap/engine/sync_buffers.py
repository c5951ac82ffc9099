"""Averaging of the buffers of a model over the ranks, such as statistics of batch norms."""

from mmdet3d.registry import HOOKS
from mmengine.dist import all_reduce_params
from mmengine.hooks import EMAHook, SyncBuffersHook
from mmengine.runner import Runner


@HOOKS.register_module()
class MapSyncBuffersHook(SyncBuffersHook):
    """mmengine's `SyncBuffersHook`, which also averages the buffers of averaged weights.

    `EMAHook` copies the buffers of each rank, and saves those of the first rank. Without this hook,
    the saved model would have other batch statistics than the validated one.
    """

    def before_val_epoch(self, runner: Runner) -> None:
        """Average the buffers, unless they were averaged at the end of the epoch."""
        if self.distributed and not self.called_in_train:
            _average_ema_buffers(runner)
        super().before_val_epoch(runner)

    def after_train_epoch(self, runner: Runner) -> None:
        """Average the buffers at the end of an epoch."""
        super().after_train_epoch(runner)
        if self.distributed:
            _average_ema_buffers(runner)


def _average_ema_buffers(runner: Runner) -> None:
    """Average the buffers of the averaged weights of all `EMAHook` over the ranks."""
    for hook in runner.hooks:
        if isinstance(hook, EMAHook):
            # `module` leaves out the number of averaged steps, which is a buffer, too.
            all_reduce_params(hook.ema_model.module.buffers(), op="mean")
