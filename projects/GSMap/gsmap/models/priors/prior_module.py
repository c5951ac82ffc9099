"""Base class of the parts of a detector that read maps of earlier frames.

A map prior, or prior, is a map of one place, a town or a scene. It is made of the predictions of
earlier frames there. The maps of several places are in an object of the class `PlaceMaps`.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, ClassVar

from mmengine.model import BaseModule
from mmengine.structures import InstanceData

from gsmap.models.base.head import MapHead
from gsmap.models.base.hooks import FlowHook
from gsmap.prior.map_prior import MapPrior
from gsmap.prior.opening import AnyPrior
from gsmap.prior.places import GivenMaps, PlaceMaps
from gsmap.utils.errors import InputError


class PriorModule(BaseModule):
    """Part ``prior`` of a `MapDetector`, which reads maps of earlier frames.

    For each batch, the detector calls methods in this order:

    1. `fuse` with the outputs of the encoder, before the head.
    2. `hook`, which returns an object that takes part in the steps of the head, or None.
    3. `update_detections` with the detections of the head, only in a prediction, not in training.
    4. `keep` with the object of `hook`, if there is one. It has received the predictions of the
       head.

    In this base class, these methods have no effect.

    Args:
        head: Head of the detector, a `MapHead`.
        cell_m: Side in metres of the square cells at which maps are read.
        init_cfg: Initialisation config of mmengine.

    Attributes:
        reads_window: Whether `fuse` needs a window of a map, the part around the frame. It is then
            an input of an exported network.
        window: Extent of the part of a map around a frame, and the cells at which it is read.
        classes: Names of the classes.

    Raises:
        ValueError: If the head is no `MapHead`.
    """

    reads_window: ClassVar[bool] = False

    def __init__(self, head: Any, cell_m: float, init_cfg: dict | None = None) -> None:
        super().__init__(init_cfg)
        if not isinstance(head, MapHead):
            raise InputError(f"{type(head).__name__} can have no prior, which needs a MapHead.")
        self.window = head.grid.rasterized(cell_m)
        self.classes = head.classes
        # Maps that `use` has received. If None, a subclass reads and writes maps that it has
        # created, the maps of the model.
        self._given: PlaceMaps | None = None

    @property
    def calibration(self) -> tuple[str, ...]:
        """Names of the arrays of calibration that `fuse` reads; none in this base class."""
        return ()

    def new_maps(self) -> PlaceMaps:
        """Create the maps of a training or a test.

        In this base class they are always empty, because nothing is written to them. A subclass
        that writes maps creates other ones.
        """
        return PlaceMaps(self.classes, self.window, memory="none")

    def new_prior(self, place: str) -> MapPrior:
        """Create the empty prior of a place, for a user who lets the model write to it.

        Args:
            place: Name of the place.

        Raises:
            ValueError: If the model writes to no prior, as in this base class.
        """
        raise InputError(
            f"a model with {type(self).__name__} writes to no prior: leave the update out."
        )

    def maps_of(self, priors: Sequence[AnyPrior], update: bool = False) -> GivenMaps:
        """Wrap the priors of a user as maps for `use` and `using`.

        Args:
            priors: The priors, one for each place.
            update: Whether each frame is written to the priors after it is predicted.

        Returns:
            Maps that find the prior of a frame by the place of the frame.

        Raises:
            ValueError: If there is no prior, if a prior has other classes or cells, if two priors
                are of one place, or if this module does not read or write such priors.
        """
        return GivenMaps(priors, self.classes, grid=self.window, update=update)

    def flush(self) -> None:
        """Write the predictions that were passed to `keep` into the maps.

        These are the maps that were in use when the predictions were made.
        """

    def use(self, maps: PlaceMaps | None) -> None:
        """Use these maps in tests from now on.

        Args:
            maps: Maps of `maps_of` or `new_maps`; None for the maps that the model has created.
        """
        self.flush()  # predictions so far belong to the maps before
        self._given = maps

    @contextmanager
    def using(self, maps: PlaceMaps) -> Iterator[None]:
        """Context manager that uses these maps, and writes all predictions at its end.

        Args:
            maps: Maps of `maps_of` or `new_maps`.
        """
        previous = self._given
        self.use(maps)
        try:
            yield
        finally:
            self.use(previous)  # writes the predictions first

    def fuse(
        self,
        outputs: Mapping[str, Any],
        metas: Sequence[dict[str, Any]],
        img_shape: tuple[int, int],
    ) -> dict[str, Any]:
        """Fuse the outputs of the encoder with the maps.

        Args:
            outputs: Outputs of the encoder: ``bev_feats`` (B, C, H, W), ``img_feats``.
            metas: Metainfo of each sample.
            img_shape: Rows and columns of the padded images.

        Returns:
            The outputs for the head, in a new dictionary.
        """
        return dict(outputs)

    def hook(self, outputs: Mapping[str, Any]) -> FlowHook | None:
        """Create the hook that the head calls for a batch; None for no hook.

        Args:
            outputs: Outputs of `fuse`.
        """
        return None

    def update_detections(
        self, results: Sequence[InstanceData], metas: Sequence[Mapping[str, Any]]
    ) -> list[InstanceData]:
        """Update the detections of a batch by the maps.

        Args:
            results: Detections of each sample, as predicted by the head.
            metas: Metainfo of each sample.

        Returns:
            Detections of each sample.
        """
        return list(results)

    def keep(self, hook: Any, metas: Sequence[Mapping[str, Any]]) -> None:
        """Store the predictions of a batch until `flush` writes them.

        Args:
            hook: Result of `hook` for the batch, after the head has run. If there is no hook, the
                detector does not call this method.
            metas: Metainfo of each sample.
        """
