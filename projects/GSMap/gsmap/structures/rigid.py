"""Rigid transforms."""

from typing import Any

import numpy as np
import numpy.typing as npt
from numpy.typing import NDArray

from gsmap.utils.errors import InputError


def rigid(rotation: npt.ArrayLike, translation: npt.ArrayLike) -> NDArray[np.float64]:
    """Return a rotation (3, 3) and a translation (3,) as one transform. (4, 4)"""
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = rotation, translation
    return transform


def invert_rigid(transform: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """Return the inverse of a rotation with a translation, without a linear solver.

    A general inverse of thousands of small matrices spends its time in starting threads. ValueError
    if the shape is not (..., 4, 4). (..., 4, 4) -> (..., 4, 4)
    """
    matrices = np.asarray(transform, np.float64)
    if matrices.shape[-2:] != (4, 4):
        raise InputError(f"transform must have shape (..., 4, 4), got {matrices.shape}.")
    inverse = np.zeros_like(matrices)
    rotation = matrices[..., :3, :3].swapaxes(-1, -2)
    inverse[..., :3, :3] = rotation
    inverse[..., :3, 3] = -np.einsum("...ij,...j->...i", rotation, matrices[..., :3, 3])
    inverse[..., 3, 3] = 1.0
    return inverse


@np.errstate(invalid="ignore", over="ignore")
def is_rigid(transform: NDArray[np.floating[Any]], tolerance: float = 1e-3) -> NDArray[np.bool_]:
    """Say which matrices are a proper rotation with a finite translation. (..., 4, 4) -> (...)

    ``tolerance`` is how far products of the rotation's rows may be off.
    """
    m = np.moveaxis(transform, (-2, -1), (0, 1)).copy()  # (4, 4, ...): each entry in one piece
    (x, y, z), shift = m[:3, :3], m[:3, 3]
    mirror = np.cross(x, y, axis=0) - z
    errors = (x * x).sum(0) - 1, (y * y).sum(0) - 1, (x * y).sum(0), *mirror
    good = np.isfinite(shift.sum(0)) & (m[3, 3] == 1) & ~m[3, :3].any(0)
    for error in errors:
        good &= np.abs(error) < tolerance
    return good
