"""Position of the global frame of a map on the Earth."""

import warnings
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from gsmap.datasets.annotations.record import AnnotationMeta
from gsmap.structures.elements import FloatArray
from gsmap.utils.errors import InputError
from gsmap.utils.extras import import_extra

# Largest absolute x and y of a map around an origin. Coordinates of a map grid are usually larger.
_FARTHEST_M = 100_000.0
_BEYOND_AREA_DEG = 5.0  # maps of a country leave the area of a grid by some degrees
_STEP_M = 100.0  # length along which a metre of a grid is compared with a metre on the ground
_MAX_STRETCH = 0.01  # largest difference of a metre of a grid from a metre on the ground


@dataclass(frozen=True)
class MapOrigin:
    """Origin of a global frame whose x axis points east and whose y axis points north.

    Args:
        latitude_deg: Latitude of the origin on the WGS 84 ellipsoid in degrees, in (-90, 90).
        longitude_deg: Longitude of the origin in degrees, in [-180, 180].
        utm_zone: Number of the UTM zone whose grid the axes are parallel to. By default, the axes
            point to true east and north at the origin.

    Raises:
        ValueError: If the latitude or the longitude is out of range.
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
        """Projection from degrees to metres (transverse Mercator).

        Its coordinates at the origin are not zero for a UTM zone, so callers subtract them. Raises
        RuntimeError if ``pyproj``, which the extra ``maps`` installs, is missing.
        """
        create_projection = import_extra("pyproj", "maps").Proj
        if self.utm_zone is not None:
            return create_projection(proj="utm", zone=self.utm_zone, ellps="WGS84")
        return create_projection(
            proj="tmerc", lat_0=self.latitude_deg, lon_0=self.longitude_deg, ellps="WGS84"
        )

    def lon_lat(self, points: FloatArray) -> FloatArray:
        """Convert points to longitude and latitude on the WGS 84 ellipsoid.

        Args:
            points: Points in metres in the global frame. (n, >= 2)

        Returns:
            Longitude and latitude in degrees. (n, 2)

        Raises:
            ValueError: If a point is too far from the origin for the projection.
            RuntimeError: If ``pyproj`` is missing.
        """
        origin_x, origin_y = self._projection(self.longitude_deg, self.latitude_deg)
        x, y = np.asarray(points)[:, :2].T
        lon_deg, lat_deg = self._projection(x + origin_x, y + origin_y, inverse=True)
        degrees = np.stack([lon_deg, lat_deg], axis=1)
        # The projection returns infinity for a point without longitude and latitude.
        if not np.isfinite(degrees).all():
            farthest_m = max(np.abs(x).max(), np.abs(y).max())
            raise InputError(
                f"the map reaches {farthest_m:.3g} m from the origin of "
                "its frame, where there is no longitude and latitude: check its poses, or write it "
                "in metres, by --formats geojson without --origin."
            )
        return degrees

    def points_of(self, lon_lat: FloatArray, where: str) -> FloatArray:
        """Convert longitude and latitude to points in the global frame, the inverse of `lon_lat`.

        Args:
            lon_lat: Longitude and latitude in degrees. (n, 2)
            where: Name of the file, for the message.

        Returns:
            Points in metres. (n, 2)

        Raises:
            ValueError: If a longitude or latitude is out of range, or x or y of a point is larger
                than 100 km.
            RuntimeError: If ``pyproj`` is missing.
        """
        longitude_deg, latitude_deg = _require_degrees(lon_lat, where).T
        origin_xy = self._projection(self.longitude_deg, self.latitude_deg)
        x, y = self._projection(longitude_deg, latitude_deg)
        points = np.stack([x, y], axis=1) - origin_xy
        farthest_m = np.abs(points).max(initial=0.0)
        if not farthest_m <= _FARTHEST_M:  # `not <=` is also true of NaN
            raise InputError(
                f"{where}: the map lies {farthest_m / 1000:.0f} km from the origin "
                f"{self.latitude_deg:g} {self.longitude_deg:g} of the global frame: give the "
                "origin of this map (LAT LON), or a map of the place at this origin."
            )
        return points


@dataclass(frozen=True)
class MapGrid:
    """Coordinate reference system of a global frame that is a map grid.

    A map grid is a standard projection with coordinates in metres, such as a UTM zone. It takes the
    place of a `MapOrigin`.

    Args:
        crs: Name of the system for ``pyproj``, such as ``EPSG:32650``. The easting of the system is
            x of the global frame, and its northing is y.

    Raises:
        RuntimeError: If ``pyproj`` is missing.
        ValueError: If the system does not exist, or is not a grid in metres.
    """

    crs: str

    def __post_init__(self) -> None:
        crs_class = import_extra("pyproj", "maps").CRS
        try:
            system = crs_class.from_user_input(self.crs)
        except Exception as error:  # CRSError, which is not a ValueError
            raise InputError(f"{self.crs} is no coordinate reference system: {error}.") from error
        units = {axis.unit_name for axis in system.axis_info[:2]}  # of the two horizontal axes
        if not system.is_projected or units != {"metre"}:
            raise InputError(
                f"{self.crs} ({system.name}) is no grid in metres: give the grid of the poses, "
                "such as EPSG:32650."
            )

    def require_inside(self, positions: FloatArray, where: str) -> None:
        """Check that positions are coordinates of the grid, in metres on the ground.

        Positions near the origin of the grid and outside of its area are probably metres from
        another origin. Other positions far outside of it are probably northings and eastings.

        Args:
            positions: Positions of the vehicle in the global frame. (n, >= 2)
            where: Name of the file, for the message.

        Raises:
            ValueError: If a position has no longitude and latitude, if it is outside of the area of
                the grid (by more than 5 degrees, if a coordinate is larger than 100 km), or if a
                metre of the grid differs there by more than 1 percent from a metre on the ground,
                as in Web Mercator, or if the axes of the grid are mirrored, as the southing and
                westing of EPSG:5513.
        """
        points = np.asarray(positions)[:, :2]
        pyproj = import_extra("pyproj", "maps")
        system = pyproj.CRS.from_user_input(self.crs)
        lon_deg, lat_deg = self.lon_lat(points).T
        is_wrong = ~(np.isfinite(lon_deg) & np.isfinite(lat_deg))
        area = system.area_of_use  # bounds in degrees; None if the system has no known area
        if area is not None:
            is_local = np.abs(points).max(initial=0.0) <= _FARTHEST_M
            margin_deg = 0.0 if is_local else _BEYOND_AREA_DEG
            # Longitudes are measured eastward from the western bound, because an area may cross the
            # meridian of 180 degrees, where its eastern bound is smaller than its western bound.
            # pyproj returns infinity for a point without a longitude. Its remainder is NaN, without
            # a warning of numpy.
            with np.errstate(invalid="ignore"):
                from_west_deg = (lon_deg - area.west + margin_deg) % 360.0
            width_deg = (area.east - area.west) % 360.0
            if width_deg == 0.0:  # the whole Earth
                width_deg = 360.0
            is_wrong |= from_west_deg > width_deg + 2 * margin_deg
            is_wrong |= lat_deg < area.south - margin_deg
            is_wrong |= lat_deg > area.north + margin_deg
        if is_wrong.any():
            x, y = points[is_wrong.argmax()]  # the first wrong position
            raise InputError(
                f"{where}: the position {x:.0f} {y:.0f} is outside of the area of {self.crs} "
                f"({system.name}): x must be the easting and y the northing in this grid; if "
                "positions are metres from a place, give its --origin LAT LON instead of --crs."
            )
        geod = pyproj.Geod(ellps="WGS84")
        stretch = np.zeros(len(points))
        headings_deg = []  # of x and of y, clockwise from north
        for step_m in ((_STEP_M, 0.0), (0.0, _STEP_M)):  # along x and along y
            next_lon_deg, next_lat_deg = self.lon_lat(points + step_m).T
            heading_deg, _, ground_m = geod.inv(lon_deg, lat_deg, next_lon_deg, next_lat_deg)
            stretch = np.fmax(stretch, np.abs(_STEP_M / ground_m - 1.0))
            headings_deg.append(heading_deg)
        x_deg, y_deg = headings_deg
        # x is a quarter turn clockwise from y, unless the axes are the southing and the westing.
        if np.sin(np.radians(x_deg - y_deg)).min(initial=1.0) < 0:
            raise InputError(
                f"{where}: maps in {self.crs} ({system.name}) are mirrored, because its axes are "
                "not the easting and the northing: transform the poses to the grid that has them, "
                "such as EPSG:5514 in place of EPSG:5513."
            )
        if stretch.max(initial=0.0) > _MAX_STRETCH:
            x, y = points[stretch.argmax()]
            raise InputError(
                f"{where}: a metre of {self.crs} ({system.name}) differs by {stretch.max():.0%} "
                f"from a metre on the ground at the position {x:.0f} {y:.0f}: transform the poses "
                "to a grid of the place, such as its UTM zone."
            )

    def accuracy_warning(self, positions: FloatArray) -> str | None:
        """Describe the error of longitude and latitude if ``pyproj`` lacks a file of corrections.

        National grids of older surveys need such files, which ``pyproj`` does not contain. Without
        them it uses a transformation that is some metres off.

        Args:
            positions: Positions of the vehicle inside of the grid (`require_inside`), in metres.
                (n >= 1, >= 2)

        Returns:
            Warning, or None if the most accurate transformation is available.
        """
        pyproj = import_extra("pyproj", "maps")
        create_group = import_extra("pyproj.transformer", "maps").TransformerGroup
        create_area = import_extra("pyproj.aoi", "maps").AreaOfInterest
        lon_lat = self.lon_lat(positions)
        west_deg, south_deg = lon_lat.min(axis=0)
        east_deg, north_deg = lon_lat.max(axis=0)
        area = create_area(west_deg, south_deg, east_deg, north_deg)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of pyproj, about the missing file
            group = create_group(self.crs, "EPSG:4326", always_xy=True, area_of_interest=area)
        if group.best_available or not group.transformers:
            return None
        best = group.unavailable_operations[0]
        names = [grid.short_name for grid in best.grids if not grid.available]
        accuracy_m = group.transformers[0].accuracy  # of the transformation in use; -1 if unknown
        stated = f"{accuracy_m:g}" if accuracy_m > 0 else "an unknown number of"
        system = pyproj.CRS.from_user_input(self.crs)
        commands = " and ".join(f"pyproj sync --file {name}" for name in names)
        return (
            f"longitude and latitude in {self.crs} ({system.name}) are only accurate to "
            f"{stated} m (as pyproj states, at some places less), as pyproj lacks files of the "
            f"best transformation: get them by {commands}. Maps written in metres are not affected."
        )

    @cached_property
    def _transformer(self) -> Any:
        """Transformation from the grid (easting, northing) to longitude and latitude on WGS 84."""
        pyproj = import_extra("pyproj", "maps")
        # EPSG:4326 lists the latitude first. `always_xy` selects the order (longitude, latitude).
        return pyproj.Transformer.from_crs(self.crs, "EPSG:4326", always_xy=True)

    def lon_lat(self, points: FloatArray) -> FloatArray:
        """Convert points to longitude and latitude on the WGS 84 ellipsoid.

        Args:
            points: Points in metres of the grid. (n, >= 2)

        Returns:
            Longitude and latitude in degrees; infinite for a point that has none. (n, 2)
        """
        x, y = np.asarray(points)[:, :2].T
        lon_deg, lat_deg = self._transformer.transform(x, y)
        return np.stack([lon_deg, lat_deg], axis=1)

    def points_of(self, lon_lat: FloatArray, where: str) -> FloatArray:
        """Convert longitude and latitude to points in the grid, the inverse of `lon_lat`.

        Args:
            lon_lat: Longitude and latitude in degrees. (n, 2)
            where: Name of the file, for the message.

        Returns:
            Points in metres. (n, 2)

        Raises:
            ValueError: If a longitude or latitude is out of range, or a point has no coordinates in
                the grid.
        """
        longitude_deg, latitude_deg = _require_degrees(lon_lat, where).T
        x, y = self._transformer.transform(longitude_deg, latitude_deg, direction="INVERSE")
        points = np.stack([x, y], axis=1)
        if not np.isfinite(points).all():
            raise InputError(f"{where}: the map lies outside of the grid {self.crs}.")
        return points


def _require_degrees(lon_lat: FloatArray, where: str) -> FloatArray:
    """Return the coordinates (n, 2) unless a longitude exceeds 180 or a latitude 90 degrees."""
    longitude_deg, latitude_deg = lon_lat.T
    if not (np.abs(longitude_deg).max() <= 180 and np.abs(latitude_deg).max() <= 90):
        raise InputError(
            f"{where} has coordinates that are no longitude and latitude: if they are metres of "
            'the global frame, give the file the member "crs": null.'
        )
    return lon_lat


def require_near(positions: FloatArray, where: str) -> None:
    """Check that positions are near the origin of the global frame.

    Positions far from it are probably coordinates of a grid.

    Args:
        positions: Positions of the vehicle in metres in the global frame. (n, >= 2)
        where: Name of the file, for the message.

    Raises:
        ValueError: If a coordinate is larger than 100 km.
    """
    farthest_m = float(np.abs(np.asarray(positions)[:, :2]).max(initial=0.0))
    if farthest_m > _FARTHEST_M:
        raise InputError(
            f"{where}: positions lie up to {farthest_m / 1000:.0f} km from the origin, so they are "
            "no metres from it: if they are coordinates of a grid, give --crs (such as EPSG:32650 "
            "for UTM zone 50) instead of --origin."
        )


def known_origin(meta: AnnotationMeta, map_name: str) -> MapOrigin | None:
    """Look up the origin of a map in the devkit of its data set.

    The origin of the poses of nuScenes is the south-western corner of a map. The devkit calls its
    latitude and longitude the reference coordinate. The poses of Argoverse 2 are UTM coordinates
    minus the origin of the city.

    Args:
        meta: Metadata of the annotation file.
        map_name: Name of the map.

    Returns:
        Origin, or None for other data sets and for maps that the devkit does not list.
    """
    # The devkits are imported here, because each of them is needed for one data set only.
    if meta.dataset == "nuscenes":
        from nuscenes.scripts.export_poses import REFERENCE_COORDINATES

        if map_name in REFERENCE_COORDINATES:
            latitude_deg, longitude_deg = REFERENCE_COORDINATES[map_name]
            return MapOrigin(latitude_deg, longitude_deg)
    if meta.dataset == "av2":
        from av2.geometry.utm import CITY_ORIGIN_LATLONG_DICT, UTM_ZONE_MAP

        for city, (latitude_deg, longitude_deg) in CITY_ORIGIN_LATLONG_DICT.items():
            if map_name == city.value:
                return MapOrigin(latitude_deg, longitude_deg, utm_zone=UTM_ZONE_MAP[city])
    return None
