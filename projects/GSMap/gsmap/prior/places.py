"""Map priors of several places: maps of the predictions of earlier drives.

A window is the part of a map in the range of a frame. Maps are read and written by windows.
"""

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsmap.prior.map_prior import MapPrior
from gsmap.prior.opening import AnyPrior
from gsmap.prior.rules import WriteRule
from gsmap.prior.settings import PriorSettings
from gsmap.structures.grid import BEVGrid
from gsmap.structures.rigid import is_rigid
from gsmap.utils.errors import InputError

_MOST_SCENES = 16  # largest number of maps that are kept with memory="scene"


class Place(NamedTuple):
    """Place of a frame in the world.

    Attributes:
        token: Name of the frame's sample.
        name: Name of the town or map; empty if it is unknown.
        scene: Name of the scene; empty if it is unknown.
        pose: Transform from the annotation frame to the world in metres. (4, 4)
    """

    token: str
    name: str
    scene: str
    pose: NDArray[np.float64]

    @classmethod
    def of(cls, meta: Mapping[str, Any]) -> "Place | None":
        """Place of a sample, or None if its pose is unknown.

        Args:
            meta: Metainfo with ``lidar2global`` (4, 4) and, if they are known, ``token``,
                ``map_name`` and ``scene``.

        Raises:
            ValueError: If the pose is not a rigid motion.
        """
        if meta.get("lidar2global") is None:
            return None
        token = str(meta.get("token"))
        pose = np.asarray(meta["lidar2global"], dtype=np.float64)
        if pose.shape != (4, 4) or not is_rigid(pose):
            raise InputError(
                f"lidar2global of sample {token!r} must be a rigid motion (4, 4) to the world."
            )
        name = str(meta.get("map_name") or "")
        return cls(token, name=name, scene=str(meta.get("scene") or ""), pose=pose)


class PlaceMaps:
    """Map priors of towns or scenes, which are empty at first.

    Args:
        classes: Names of the classes.
        grid: Extent and cells of the window of a frame, the part of a map that is read and written.
        rule: Rule by which the raster of a frame changes a map; None for the default of `MapPrior`.
        memory: ``"kept"``: one map for all frames in a town (`Place.name`), or for each scene if
            the town is unknown. ``"scene"``: one map for each scene. ``"none"``: nothing is
            written.

    Attributes:
        memories: Valid values of ``memory``.
        writes: Whether `write` changes the maps.

    Raises:
        ValueError: If ``memory`` is unknown, or the cells are not square.
    """

    memories: ClassVar[tuple[str, ...]] = ("kept", "scene", "none")

    def __init__(
        self,
        classes: Sequence[str],
        grid: BEVGrid,
        rule: WriteRule | None = None,
        memory: str = "kept",
    ) -> None:
        if memory not in self.memories:
            raise InputError(
                f"the memory of a prior must be one of {self.memories}, got {memory!r}."
            )
        width_m, height_m = grid.pixel_size_m
        if abs(width_m - height_m) > 1e-6:
            raise InputError(f"cells of a prior must be squares, got {width_m:g} x {height_m:g} m.")
        self.classes = tuple(classes)
        self.grid = grid
        self.rule = rule
        self.memory = memory
        self.writes = memory != "none"
        # Rounded, because the extent divided by the number of cells may be 0.30000000000000004.
        self.cell_m = round(width_m, 6)
        # Maps by the names of `_key`, the oldest first.
        self._priors: OrderedDict[str, AnyPrior] = OrderedDict()

    def settings_of(self, name: str) -> PriorSettings:
        """Settings of the map of a town or scene, by its name."""
        return PriorSettings(self.classes, place=name, cell_m=self.cell_m)

    def find(self, place: Place) -> AnyPrior | None:
        """Map at a place, or None if nothing has been written there."""
        return self._priors.get(self._key(place))

    def find_or_create(self, place: Place) -> AnyPrior:
        """Map at a place. It is created if it does not exist."""
        key = self._key(place)
        if key not in self._priors:
            if self.memory == "scene" and len(self._priors) >= _MOST_SCENES:
                _, oldest = self._priors.popitem(last=False)  # the map that was created first
                if isinstance(oldest, MapPrior):
                    oldest.close()  # releases its memory
            self._priors[key] = MapPrior(self.settings_of(key), rule=self.rule)
        return self._priors[key]

    def _key(self, place: Place) -> str:
        """Name of the map for a place: the town, or the scene."""
        if self.memory == "scene" or not place.name:
            return f"{place.name} scene {place.scene}"
        return place.name

    def read(self, place: Place | None) -> Tensor:
        """Read the window of a frame.

        Args:
            place: Place of the frame; None if it is unknown.

        Returns:
            Values in [0, 1] on the CPU, 0 where nothing is known. (classes, H, W)
        """
        unknown = torch.zeros(len(self.classes), self.grid.height, self.grid.width)
        if place is None or self.memory == "none":
            return unknown
        prior = self.find(place)
        if prior is None:
            return unknown
        return prior.read(place.pose, self.grid)

    def write(self, place: Place | None, raster: Tensor) -> None:
        """Write the rasterized prediction of a frame; do nothing if the place is unknown.

        Args:
            place: Place of the frame; None if it is unknown.
            raster: Values in [0, 1]. (classes, H, W)
        """
        if place is not None and self.writes:
            prior = self.find_or_create(place)
            assert isinstance(prior, MapPrior)  # `GivenMaps` refuses other priors if it writes
            prior.write(place.pose, self.grid, values=raster)
            prior.sources.add(place.token)


class GivenMaps(PlaceMaps):
    """Map priors of a user, one for each town (`Place.name`).

    Args:
        priors: The priors.
        classes: Names of the classes.
        grid: Extent and cells of the window of a frame, the part of a map that is read and written.
        update: Whether to write each frame after it is predicted.

    Raises:
        ValueError: If there is no prior, a prior has other classes or cells, two priors are of one
            town, or ``update`` is True and a prior is not a `MapPrior`.
    """

    def __init__(
        self,
        priors: Sequence[AnyPrior],
        classes: Sequence[str],
        grid: BEVGrid,
        update: bool = False,
    ) -> None:
        if not priors:
            raise InputError("the list of priors is empty: give a prior, or None instead.")
        super().__init__(classes, grid)  # no rule: this class creates no maps
        self.writes = update
        for prior in priors:
            name = prior.settings.place
            expected = self.settings_of(name)
            given = prior.settings
            if not isinstance(prior, MapPrior):
                if update:
                    raise InputError(
                        f"the prior of {name!r} has {prior.content}, which a model can only read: "
                        "leave the update out; tools/build_map.py --prior builds a new one."
                    )
                # These priors have no cells: they are drawn on the cells of a window. So the sizes
                # of cells and tiles are not compared below.
                given = replace(given, cell_m=expected.cell_m, tile_m=expected.tile_m)
            # Compares classes, place, cells and tiles, and raises an error if one differs.
            expected.require_equal(given, f"the prior of {name!r}")
            if name in self._priors:
                raise InputError(f"two priors are of {name!r}: give one for each place.")
            self._priors[name] = prior

    def __deepcopy__(self, memo: dict[int, Any]) -> "GivenMaps":
        """The maps themselves: they belong to the user and are not copied."""
        return self

    def find(self, place: Place) -> AnyPrior:
        """Map at a place. If there is a single map, it is also used for frames of unknown towns.

        Raises:
            ValueError: If there is no map of the place.
        """
        if not place.name and len(self._priors) == 1:
            (prior,) = self._priors.values()
            return prior
        if place.name not in self._priors:
            raise InputError(
                f"sample {place.token!r} is in {place.name or 'an unknown place'!r}, and the "
                f"priors are of {sorted(self._priors)}: give the prior of this place, too."
            )
        return self._priors[place.name]

    def find_or_create(self, place: Place) -> AnyPrior:
        """Map at a place, as returned by `find`: no map is created."""
        return self.find(place)

    def require_place(self, place: Place | None) -> Place:
        """Return the place of a frame.

        Raises:
            ValueError: If the place is unknown.
        """
        if place is None:
            raise InputError(
                "a prior is read at the pose of a frame, and a sample has none: leave the prior "
                "out, or give each sample its pose (lidar2global)."
            )
        return place

    def read(self, place: Place | None) -> Tensor:
        """Read the window of a frame. (classes, H, W)

        Raises:
            ValueError: If the place of the frame is unknown, or has no map.
        """
        known_place = self.require_place(place)
        window = super().read(known_place)
        self.find(known_place).reads.add(is_empty=not window.any())
        return window
