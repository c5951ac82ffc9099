"""Calibration of a sample as arrays for the BEV encoders of cameras."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsmap.utils.errors import InputError

NUM_CAN_BUS = 18
# Entries of ``can_bus`` that need no earlier frame. The first three and the last one are the motion
# since the previous frame.
OF_ONE_FRAME = slice(3, 17)

# Camera that is 1 km away from the vehicle along +y of the annotation frame and looks along +y. The
# whole range of the map is behind the camera, and its frustum is out of range. So it contributes to
# no BEV cell, neither by projection nor by lifting.
OUT_OF_SIGHT = np.array(
    [[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, -1000.0], [0, 0, 0, 1.0]]
)  # cam_from_frame


def without_history(can_bus: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    """Set the vehicle signals outside of `OF_ONE_FRAME` to zero, as in MapTR for a single frame.

    Args:
        can_bus: Vehicle signals in MapTR's layout. (18,)

    Returns:
        Vehicle signals. (18,)

    Raises:
        ValueError: If the number of signals is wrong.
    """
    if can_bus.shape != (NUM_CAN_BUS,):
        raise InputError(f"can_bus must hold {NUM_CAN_BUS} values, got shape {can_bus.shape}.")
    signals = np.zeros_like(can_bus)
    signals[OF_ONE_FRAME] = can_bus[OF_ONE_FRAME]
    return signals


def calibration_arrays(
    meta: Mapping[str, Any], names: Iterable[str]
) -> dict[str, NDArray[np.float32]]:
    """Compute arrays for an encoder from the metainfo of a sample.

    The arrays are:

    * ``img_from_frame`` and its inverse ``frame_from_img``: between metres in the annotation frame
      and (u * d, v * d, d, 1), with pixels u, v of the image of the network and depth d in metres.
    * ``img_from_ground`` and its inverse ``ground_from_img``: as above, but z of the annotation
      frame is replaced by the height above the ground, the plane z = 0 of the vehicle.
    * ``cam_from_ground`` and ``ego_from_cam``: transforms in metres. Points on the side of the
      ground are (x, y, height above the ground), as above.
    * ``cam2img``, ``img_aug_matrix`` and ``can_bus``: fields of the metainfo. ``can_bus`` is
      processed by `without_history`, and zero if the sample lacks it.

    Args:
        meta: Metainfo of the sample: ``lidar2img``, ``lidar2cam``, ``cam2img`` and
            ``img_aug_matrix`` (V, 4, 4), ``lidar2ego`` (4, 4) and ``can_bus`` (18,), as far as the
            arrays need them. In these names, ``lidar`` is the annotation frame.
        names: Names of the arrays, from the list above.

    Returns:
        Arrays by name: ``can_bus`` (18,), others (V, 4, 4).

    Raises:
        ValueError: If the sample lacks a field other than ``can_bus``, or ``can_bus`` has a wrong
            number of signals.
    """

    def field(key: str) -> NDArray[np.floating[Any]]:
        if meta.get(key) is None:
            if key == "can_bus":
                return np.zeros(NUM_CAN_BUS)
            raise InputError(
                f"sample {meta.get('token')!r} has no {key!r} in its metainfo: pack it in the "
                "pipeline; lidar2ego comes from ego_from_frame of the sample's record "
                "(docs/custom_data.md)."
            )
        value = np.asarray(meta[key], dtype=np.float64)
        return without_history(value) if key == "can_bus" else value

    def img_from_ground() -> NDArray[np.float64]:
        return field("lidar2img") @ _frame_from_ground(field("lidar2ego"))

    # Inverses are computed in float64, so that their float32 values are correctly rounded. The
    # entries are functions, so that only the fields of the requested arrays are needed.
    derived = {
        "img_from_frame": lambda: field("lidar2img"),
        "img_from_ground": img_from_ground,
        "ground_from_img": lambda: np.linalg.inv(img_from_ground()),
        "cam_from_ground": lambda: field("lidar2cam") @ _frame_from_ground(field("lidar2ego")),
        "frame_from_img": lambda: np.linalg.inv(field("lidar2img")),
        "ego_from_cam": lambda: field("lidar2ego") @ np.linalg.inv(field("lidar2cam")),
    }
    arrays = {}
    for name in names:
        values = derived[name]() if name in derived else field(name)
        arrays[name] = values.astype(np.float32)
    return arrays


def stack_calibration_arrays(
    metas: Sequence[Mapping[str, Any]], names: Sequence[str]
) -> list[NDArray[np.float32]]:
    """Stack the calibration arrays of the samples of a batch.

    Args:
        metas: Metainfo of the B samples, as in `calibration_arrays`.
        names: Names of the arrays.

    Returns:
        One array for each name, in the order of the names. (B, ...)

    Raises:
        ValueError: If a sample lacks a field.
    """
    samples = [calibration_arrays(meta, names) for meta in metas]
    batch_arrays = []
    for name in names:
        batch_arrays.append(np.stack([arrays[name] for arrays in samples]))
    return batch_arrays


def _frame_from_ground(ego_from_frame: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """Transform from (x, y, height above the plane z = 0 of the vehicle) to the annotation frame.

    (4, 4) -> (4, 4)
    """
    # With the third row (a, b, c, d), the plane is a x + b y + c z + d = 0 in the annotation frame,
    # that is z = -(a x + b y + d) / c. The height above it is added to this z.
    a, b, c, d = ego_from_frame[2]
    transform = np.eye(4)
    transform[2, 0] = -a / c
    transform[2, 1] = -b / c
    transform[2, 3] = -d / c
    return transform
