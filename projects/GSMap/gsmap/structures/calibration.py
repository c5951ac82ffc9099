"""A sample's calibration as the arrays that the cameras' BEV encoders read."""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.floating[Any]]
NUM_CAN_BUS = 18


def _field(meta: Mapping[str, Any], key: str) -> FloatArray:
    """Return one field of a sample's metainfo in float64."""
    if meta.get(key) is None:
        raise ValueError(
            f"sample {meta.get('token')!r} has no {key!r} in its metainfo: pack it in the "
            "pipeline; lidar2ego is a record's ego_from_frame (docs/custom_data.md)."
        )
    return np.asarray(meta[key], dtype=np.float64)


def _can_bus(meta: Mapping[str, Any]) -> FloatArray:
    """Return the vehicle's motion; zeros where it is not known. (18,)"""
    return np.zeros(NUM_CAN_BUS) if meta.get("can_bus") is None else _field(meta, "can_bus")


def _ego_from_cam(meta: Mapping[str, Any]) -> FloatArray:
    """Return the cameras' poses in the vehicle. (V, 4, 4)"""
    return _field(meta, "lidar2ego") @ np.linalg.inv(_field(meta, "lidar2cam"))


# Inverses are taken in float64, so that they are as exact as float32 can hold them.
_READERS: dict[str, Callable[[Mapping[str, Any]], FloatArray]] = {
    "img_from_frame": lambda meta: _field(meta, "lidar2img"),
    "frame_from_img": lambda meta: np.linalg.inv(_field(meta, "lidar2img")),
    "cam2img": lambda meta: _field(meta, "cam2img"),
    "img_aug_matrix": lambda meta: _field(meta, "img_aug_matrix"),
    "ego_from_cam": _ego_from_cam,
    "can_bus": _can_bus,
}


def calibration_arrays(
    meta: Mapping[str, Any], names: Iterable[str]
) -> dict[str, NDArray[np.float32]]:
    """Return what an encoder reads of a sample's metainfo.

    Args:
        meta: Of ``lidar2img``, ``lidar2cam``, ``cam2img``, ``img_aug_matrix`` (V, 4, 4),
            ``lidar2ego`` (4, 4) and ``can_bus`` (18,) those that the names need; ``can_bus`` may be
            absent.
        names: ``img_from_frame`` and ``frame_from_img``, between metres in the annotation frame and
            (u * d, v * d, d, 1) in pixels of the network's image; ``cam2img``; ``img_aug_matrix``;
            ``ego_from_cam``; ``can_bus``.

    Returns:
        The arrays by name. (V, 4, 4) each, ``can_bus`` (18,)

    Raises:
        ValueError: If the sample lacks a field.
    """
    return {name: _READERS[name](meta).astype(np.float32) for name in names}
