"""Reading the samples' meta dicts."""

from collections.abc import Sequence
from typing import Any

import numpy as np


def stack_matrices(img_metas: Sequence[dict[str, Any]], key: str) -> np.ndarray:
    """Stack one matrix field of the samples' metainfo, in float64. (B, ..., 4, 4)

    Raises:
        ValueError: If a sample lacks the field.
    """
    for meta in img_metas:
        if key not in meta:
            raise ValueError(
                f"sample {meta.get('token')!r} has no {key!r} in its metainfo: "
                "pack it in the pipeline."
            )
    return np.stack([np.asarray(meta[key], dtype=np.float64) for meta in img_metas])
