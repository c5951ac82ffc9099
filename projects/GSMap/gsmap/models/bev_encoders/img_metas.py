"""Reading the samples' meta dicts."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsmap.structures.calibration import calibration_arrays


def stack_calibration(
    img_metas: Sequence[dict[str, Any]], names: Sequence[str], device: torch.device
) -> dict[str, Tensor]:
    """Stack what an encoder reads of the samples, see `calibration_arrays`. (B, ...) each

    Raises:
        ValueError: If a sample lacks a field.
    """
    arrays = [calibration_arrays(meta, names) for meta in img_metas]
    return {
        name: torch.as_tensor(np.stack([each[name] for each in arrays]), device=device)
        for name in names
    }
