"""Keys of checkpoints, result files and metainfo that describe the model and its calibration.

The calibration fits the sigmas of a model, its predicted standard deviations, to the errors. The
metainfo of the training data set is stored in checkpoints.
"""

from collections.abc import Mapping
from typing import Any, cast

from gsmap.utils.errors import InputError

CHECKPOINT = "checkpoint"  # key in results: SHA-256 of the checkpoint file
PRIORS = "priors"  # key in results: place, digest and sources of each map of earlier drives
CALIBRATION = "calibration"  # key in checkpoints and results; the value has law and sigmas
# Key of metainfo: transform from the annotation frame to the ground below the rear axle.
MOUNT = "mount"
RIG = "rig"  # key of metainfo: width, height, fx, fy, cx, cy of the images in pixels, by camera
LAW_NAMES = ("normal", "laplace")  # distributions of the errors, the default first


def calibration_of(meta: Mapping[str, Any]) -> dict[str, Any]:
    """Return the validated calibration of a checkpoint or a result file.

    Args:
        meta: Metadata of the checkpoint or the result file; untrusted.

    Returns:
        ``law``, the distribution of the errors, and ``sigmas``, a number n. The calibration was
        fitted so that a central interval of the law contains the expected share of the errors. For
        any law, this share is the probability of a normal error within n standard deviations, such
        as 68.3 % for n = 1. Empty if there is no calibration.

    Raises:
        ValueError: If the law is unknown, or ``sigmas`` is not a number in (0, 3].
    """
    calibration = meta.get(CALIBRATION)
    if calibration is None:
        return {}
    # A calibration of a wrong type is treated as one without entries, which raises the error below.
    entries: Mapping[str, Any] = calibration if isinstance(calibration, Mapping) else {}
    law = entries.get("law")
    sigmas = entries.get("sigmas")
    # In Python, True and False are integers.
    is_number = isinstance(sigmas, int | float) and not isinstance(sigmas, bool)
    is_in_range = is_number and 0 < cast(float, sigmas) <= 3
    if law not in LAW_NAMES or not is_in_range:
        raise InputError(
            f"{CALIBRATION} must name a law of {LAW_NAMES} and sigmas in (0, 3], got "
            f"{calibration!r:.60}."
        )
    return {"law": law, "sigmas": sigmas}


def law_of(meta: Mapping[str, Any]) -> str:
    """Return the distribution of the errors that the sigmas describe, by default the normal one.

    Args:
        meta: Metadata of a checkpoint or a result file; untrusted.

    Raises:
        ValueError: If the calibration is not valid.
    """
    return str(calibration_of(meta).get("law", LAW_NAMES[0]))
