"""A sample's calibration as the arrays that the cameras' BEV encoders read."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsmap.utils.errors import InputError

NUM_CAN_BUS = 18
OF_ONE_FRAME = slice(3, 17)  # of ``can_bus``; the rest are changes since an earlier frame

# A camera 1 km ahead of the vehicle that looks further ahead: everything in range is behind it, and
# its frustum lies out of range. So both ways of making BEV features get nothing from it.
OUT_OF_SIGHT = np.array(
    [[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, -1000.0], [0, 0, 0, 1.0]]
)  # cam_from_frame


def without_history(can_bus: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    """Return vehicle signals as MapTR has them of a single frame: `OF_ONE_FRAME`, zeros around it.

    (18,) -> (18,); ValueError if there is another number.
    """
    if can_bus.shape != (NUM_CAN_BUS,):
        raise InputError(f"can_bus must hold {NUM_CAN_BUS} values, got shape {can_bus.shape}.")
    return np.pad(can_bus[OF_ONE_FRAME], (OF_ONE_FRAME.start, NUM_CAN_BUS - OF_ONE_FRAME.stop))


def calibration_arrays(
    meta: Mapping[str, Any], names: Iterable[str]
) -> dict[str, NDArray[np.float32]]:
    """Return what an encoder reads of a sample's metainfo. (V, 4, 4) each, ``can_bus`` (18,)

    Args:
        meta: Of ``lidar2img``, ``lidar2cam``, ``cam2img``, ``img_aug_matrix`` (V, 4, 4),
            ``lidar2ego`` (4, 4) and ``can_bus`` (18,) those that the names need. ``can_bus`` is
            given `without_history`; without it the vehicle's motion is zero.
        names: ``img_from_frame`` and ``frame_from_img``, between metres in the annotation frame and
            (u * d, v * d, d, 1) in pixels of the network's image; ``img_from_ground``, the former
            with z above the plane on which the vehicle stands, its inverse ``ground_from_img``, and
            ``cam_from_ground``, to metres of the camera; ``cam2img``; ``img_aug_matrix``;
            ``ego_from_cam``; ``can_bus``.

    Raises:
        ValueError: If the sample lacks a field.
    """

    def field(key: str) -> NDArray[np.floating[Any]]:
        if meta.get(key) is None:
            if key == "can_bus":
                return np.zeros(NUM_CAN_BUS)
            raise InputError(
                f"sample {meta.get('token')!r} has no {key!r} in its metainfo: pack it in the "
                "pipeline; lidar2ego is a record's ego_from_frame (docs/custom_data.md)."
            )
        value = np.asarray(meta[key], dtype=np.float64)
        return without_history(value) if key == "can_bus" else value

    def img_from_ground() -> NDArray[np.float64]:
        return field("lidar2img") @ _frame_from_ground(field("lidar2ego"))

    # Inverses are taken in float64, so that they are as exact as float32 can hold them.
    derived = {
        "img_from_frame": lambda: field("lidar2img"),
        "img_from_ground": img_from_ground,
        "ground_from_img": lambda: np.linalg.inv(img_from_ground()),
        "cam_from_ground": lambda: field("lidar2cam") @ _frame_from_ground(field("lidar2ego")),
        "frame_from_img": lambda: np.linalg.inv(field("lidar2img")),
        "ego_from_cam": lambda: field("lidar2ego") @ np.linalg.inv(field("lidar2cam")),
    }
    values = {name: derived[name]() if name in derived else field(name) for name in names}
    return {name: value.astype(np.float32) for name, value in values.items()}


def _frame_from_ground(ego_from_frame: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """Return what lifts (x, y, height above z = 0 of the vehicle, 1) to the annotation frame."""
    lifting = np.eye(4)
    lifting[2, [0, 1, 3]] = -ego_from_frame[2, [0, 1, 3]] / ego_from_frame[2, 2]
    return lifting
