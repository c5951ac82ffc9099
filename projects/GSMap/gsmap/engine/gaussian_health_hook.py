"""A warning when the Gaussians of a run die."""

from mmdet3d.registry import HOOKS
from mmengine.hooks import Hook
from mmengine.runner import Runner

_FIGURE = "train/at_floor"
_WINDOW, _TOO_MANY = 50, 0.5


@HOOKS.register_module()
class GaussianHealthHook(Hook):
    """Warn after an epoch in which most Gaussians of matched predictions are at their smallest.

    GSMap's head logs ``at_floor``, the share of Gaussians whose sigmas both lie within 10 % of the
    smallest; a model without Gaussians logs none, and the hook is silent.

    The share is that of the latest 50 iterations, and half of all is too many.
    """

    def after_train_epoch(self, runner: Runner) -> None:
        """Look at the latest iterations."""
        history = runner.message_hub.log_scalars.get(_FIGURE)
        if history is None:
            return
        share = history.mean(_WINDOW)
        if share >= _TOO_MANY:
            runner.logger.warning(
                f"{100 * share:.0f} % of the Gaussians of matched predictions are at their "
                "smallest size: their masks are dots, which teach nothing. Use "
                "RasterLoss(normalize='both'), lower loss_raster.loss_weight until the points are "
                "right to a metre or so, or give the masks larger pixels (map_head.masks.pixel_m): "
                "results/gaussians.md."
            )
