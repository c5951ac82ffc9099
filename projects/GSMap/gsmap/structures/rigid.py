"""Rigid transforms."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


def invert_rigid(transform: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """Return the inverse of a rotation with a translation, without a linear solver.

    A general inverse of thousands of small matrices spends its time in starting threads.

    Args:
        transform: Rigid transforms. (..., 4, 4)

    Returns:
        Their inverses. (..., 4, 4)

    Raises:
        ValueError: If the shape is not (..., 4, 4).
    """
    matrices = np.asarray(transform, np.float64)
    if matrices.shape[-2:] != (4, 4):
        raise ValueError(f"transform must have shape (..., 4, 4), got {matrices.shape}.")
    inverse = np.zeros_like(matrices)
    rotation = matrices[..., :3, :3].swapaxes(-1, -2)
    inverse[..., :3, :3] = rotation
    inverse[..., :3, 3] = -np.einsum("...ij,...j->...i", rotation, matrices[..., :3, 3])
    inverse[..., 3, 3] = 1.0
    return inverse
