"""Where a map's global frame lies on the Earth."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from gsmap.datasets.annotations.record import AnnotationMeta
from gsmap.structures.elements import FloatArray
from gsmap.utils.errors import InputError
from gsmap.utils.extras import import_extra

_FARTHEST_M = 100_000.0


@dataclass(frozen=True)
class MapOrigin:
    """Where the global frame has its origin; its x axis points east and its y axis north.

    Args:
        latitude_deg: Latitude of the origin on the WGS 84 ellipsoid, in degrees.
        longitude_deg: Longitude, in degrees.
        utm_zone: UTM zone whose grid the axes follow; None: true east and north at the origin.

    Raises:
        ValueError: If the place is not on Earth.
    """

    latitude_deg: float
    longitude_deg: float
    utm_zone: int | None = None

    def __post_init__(self) -> None:
        if not (abs(self.latitude_deg) < 90.0 and abs(self.longitude_deg) <= 180.0):
            raise InputError(
                "an origin is a latitude within 90 and a longitude within 180 degrees, got "
                f"{self.latitude_deg} {self.longitude_deg}."
            )

    @cached_property
    def _projection(self) -> Any:
        place = {"proj": "tmerc", "lat_0": self.latitude_deg, "lon_0": self.longitude_deg}
        if self.utm_zone is not None:
            place = {"proj": "utm", "zone": self.utm_zone}
        return import_extra("pyproj", "maps").Proj(ellps="WGS84", **place)

    def lon_lat(self, points: FloatArray) -> FloatArray:
        """Return longitude and latitude, in degrees on the WGS 84 ellipsoid. (n, 2)

        Points (n, >= 2) are in metres of the global frame.

        Raises:
            ValueError: If a point lies farther from the origin than the projection reaches.
        """
        east, north = self._projection(self.longitude_deg, self.latitude_deg)
        x, y = np.asarray(points)[:, :2].T
        degrees = np.stack(self._projection(x + east, y + north, inverse=True), axis=1)
        if not np.isfinite(degrees).all():
            raise InputError(
                f"the map reaches {max(np.abs(x).max(), np.abs(y).max()):.3g} m from the origin of "
                "its frame, where there is no longitude and latitude: its poses are wrong, or "
                "--formats geojson without --origin writes metres."
            )
        return degrees


@dataclass(frozen=True)
class MapGrid:
    """A coordinate reference system that the global frame's x and y are coordinates of.

    Args:
        crs: Its name, as pyproj takes it, such as ``EPSG:32650``; x is its easting.

    Raises:
        RuntimeError: If ``pyproj`` is missing.
        ValueError: If there is no such system, or it is not in metres.
    """

    crs: str

    def __post_init__(self) -> None:
        crs = import_extra("pyproj", "maps").CRS
        try:
            found = crs.from_user_input(self.crs)
        except Exception as error:  # pyproj's own is no ValueError
            raise InputError(f"{self.crs} is no coordinate reference system: {error}.") from error
        units = {axis.unit_name for axis in found.axis_info[:2]}
        if not found.is_projected or units != {"metre"}:
            raise InputError(
                f"{self.crs} ({found.name}) is no grid in metres: give that of the poses, such as "
                "EPSG:32650."
            )

    @cached_property
    def _to_degrees(self) -> Any:
        transformer = import_extra("pyproj", "maps").Transformer
        return transformer.from_crs(self.crs, "EPSG:4326", always_xy=True)

    def lon_lat(self, points: FloatArray) -> FloatArray:
        """Return longitude and latitude, in degrees on the WGS 84 ellipsoid. (n, 2)

        Points (n, >= 2) are in metres of the grid.
        """
        x, y = np.asarray(points)[:, :2].T
        return np.stack(self._to_degrees.transform(x, y), axis=1)


def require_near(positions: FloatArray, where: str) -> None:
    """Refuse positions that are too far from an origin to be metres from it.

    Args:
        positions: Of the vehicle, in metres of the global frame. (n, >= 2)
        where: Of which map, for the message.

    Raises:
        ValueError: If one is farther than `_FARTHEST_M`.
    """
    farthest_m = float(np.abs(np.asarray(positions)[:, :2]).max(initial=0.0))
    if farthest_m > _FARTHEST_M:
        raise InputError(
            f"{where}: positions lie up to {farthest_m / 1000:.0f} km from the origin, so they are "
            "no metres from it: if they are coordinates of a grid, give --crs (such as EPSG:32650 "
            "for UTM zone 50) instead of --origin."
        )


def known_origin(meta: AnnotationMeta, map_name: str) -> MapOrigin | None:
    """Return the origin that a data set's devkit gives for one of its maps.

    nuScenes' devkit takes the south-western corner of a map for both the reference coordinate that
    it lists and the origin of the poses; Argoverse 2 shifts the UTM grid to the origin of a city.
    None stands for other data sets, and maps that the devkit does not list.
    """
    if meta.dataset == "nuscenes":
        from nuscenes.scripts.export_poses import REFERENCE_COORDINATES

        if map_name in REFERENCE_COORDINATES:
            return MapOrigin(*REFERENCE_COORDINATES[map_name])
    if meta.dataset == "av2":
        from av2.geometry.utm import CITY_ORIGIN_LATLONG_DICT, UTM_ZONE_MAP

        for city, place in CITY_ORIGIN_LATLONG_DICT.items():
            if map_name == city.value:
                return MapOrigin(place[0], place[1], UTM_ZONE_MAP[city])
    return None
