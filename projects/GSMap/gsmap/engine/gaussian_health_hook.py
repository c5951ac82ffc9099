"""Warning when the Gaussians of a run collapse to their smallest size."""

from mmdet3d.registry import HOOKS
from mmengine.hooks import Hook
from mmengine.runner import Runner

_SCALAR = "train/at_floor"  # mmengine adds "train/" to the name of a logged value
_WINDOW = 50  # number of latest iterations over which the share is averaged
_WARNING_SHARE = 0.5  # smallest mean share that gives a warning


@HOOKS.register_module()
class GaussianHealthHook(Hook):
    """Warns after an epoch in which most Gaussians of matched predictions have the smallest size.

    GSMap's head logs ``at_floor``, the share of Gaussians whose two sigmas lie within 10 % of the
    lower bound. Only predictions that the loss matches with a ground truth count. The hook averages
    this share over the latest 50 iterations, and warns if the mean is at least one half. For a
    model that does not log the share, the hook does nothing.
    """

    def after_train_epoch(self, runner: Runner) -> None:
        """Check the share over the latest iterations, and log the warning."""
        history = runner.message_hub.log_scalars.get(_SCALAR)
        if history is None:
            return
        share = history.mean(_WINDOW)
        if share >= _WARNING_SHARE:
            runner.logger.warning(
                f"{100 * share:.0f} % of the Gaussians of matched predictions are at their "
                "smallest size: their masks are dots, which teach nothing. Use "
                "RasterLoss(normalize='both'), lower loss_raster.loss_weight until the points are "
                "right to a metre or so, or give the masks larger pixels (map_head.masks.pixel_m): "
                "results/gaussians.md."
            )
