"""Rigid transforms: 4 x 4 matrices of a rotation and a translation with last row 0, 0, 0, 1."""

from typing import Any

import numpy as np
import numpy.typing as npt
from numpy.typing import NDArray

from gsmap.utils.errors import InputError


def rigid(rotation: npt.ArrayLike, translation: npt.ArrayLike) -> NDArray[np.float64]:
    """Combine a rotation and a translation to a rigid transform. (3, 3), (3,) -> (4, 4)"""
    transform = np.eye(4)
    transform[:3, :3] = rotation
    transform[:3, 3] = translation
    return transform


def invert_rigid(transform: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """Invert rigid transforms without a linear solver.

    ``np.linalg.inv`` of thousands of small matrices spends most of its time on starting threads.

    Args:
        transform: Rigid transforms. This is not checked. (..., 4, 4)

    Returns:
        Inverses. (..., 4, 4)

    Raises:
        ValueError: If the shape is not (..., 4, 4).
    """
    matrices = np.asarray(transform, np.float64)
    if matrices.shape[-2:] != (4, 4):
        raise InputError(f"transform must have shape (..., 4, 4), got {matrices.shape}.")
    inverse = np.zeros_like(matrices)
    # The inverse of a rotation R is its transpose, and the inverse of a translation t is -R^T t.
    inverse_rotation = matrices[..., :3, :3].swapaxes(-1, -2)
    inverse[..., :3, :3] = inverse_rotation
    inverse[..., :3, 3] = -np.einsum("...ij,...j->...i", inverse_rotation, matrices[..., :3, 3])
    inverse[..., 3, 3] = 1.0
    return inverse


# Matrices with infinite or huge entries are not rigid. numpy must not warn about them.
@np.errstate(invalid="ignore", over="ignore")
def is_rigid(transform: NDArray[np.floating[Any]], tolerance: float = 1e-3) -> NDArray[np.bool_]:
    """Test whether matrices are proper rotations with finite translations.

    Args:
        transform: Matrices. (..., 4, 4)
        tolerance: Largest error of the dot and cross products of the rows of a rotation.

    Returns:
        Whether each matrix is rigid, False if an entry is not finite. (...)
    """
    m = np.moveaxis(transform, (-2, -1), (0, 1)).copy()  # (4, 4, ...), each entry contiguous
    x, y, z = m[:3, :3]
    shift = m[:3, 3]
    # The first two rows of a proper rotation have length 1 and are orthogonal, and the third is
    # their cross product.
    cross_error = np.cross(x, y, axis=0) - z
    errors = [(x * x).sum(0) - 1, (y * y).sum(0) - 1, (x * y).sum(0), *cross_error]
    has_last_row = (m[3, 3] == 1) & ~m[3, :3].any(0)  # 0, 0, 0, 1
    valid = np.isfinite(shift.sum(0)) & has_last_row  # a sum is finite only if all terms are
    for error in errors:
        valid &= np.abs(error) < tolerance  # False for NaN
    return valid
