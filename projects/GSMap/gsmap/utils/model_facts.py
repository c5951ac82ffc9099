"""What result files say of the model that made them, by keys that checkpoints share."""

from collections.abc import Mapping
from typing import Any

from gsmap.utils.errors import InputError

CHECKPOINT = "checkpoint"  # key in results: the SHA-256 of the file of its weights
CALIBRATION = "calibration"  # key in checkpoints and results: how the sigmas were fitted to errors
MOUNT = "mount"  # key of metainfo: from the annotation frame to the ground below the rear axle
RIG = "rig"  # key of metainfo: width, height, fx, fy, cx, cy of the images, by camera
LAW_NAMES = ("normal", "laplace")  # distributions of the errors


def calibration_of(meta: Mapping[str, Any]) -> dict[str, Any]:
    """Return law and interval (in sigmas) of a calibration, nothing where there was none.

    Args:
        meta: What a checkpoint or a result file says of itself; a stranger's words.

    Raises:
        ValueError: If it names no law that is known, or no number of sigmas.
    """
    said = meta.get(CALIBRATION)
    if said is None:
        return {}
    words: Mapping[str, Any] = said if isinstance(said, Mapping) else {}
    law, sigmas = words.get("law"), words.get("sigmas")
    if law not in LAW_NAMES or not isinstance(sigmas, int | float) or not 0 < sigmas <= 3:
        raise InputError(
            f"{CALIBRATION} must name a law of {LAW_NAMES} and sigmas in (0, 3], got {said!r:.60}."
        )
    return {"law": law, "sigmas": sigmas}


def law_of(meta: Mapping[str, Any]) -> str:
    """Return the law that sigmas are to be read by, the normal one where none is named."""
    return str(calibration_of(meta).get("law", LAW_NAMES[0]))
