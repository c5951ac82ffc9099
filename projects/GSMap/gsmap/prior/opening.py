"""Files of priors of both kinds."""

from pathlib import Path

from gsmap.prior.file_format import GAUSSIAN_MAGIC
from gsmap.prior.gaussian_prior import GaussianPrior
from gsmap.prior.map_prior import MapPrior

AnyPrior = MapPrior | GaussianPrior
"""Priors that a model reads."""


def open_prior(path: str | Path, update: bool = False) -> AnyPrior:
    """Open the file of a prior, whose first bytes tell its kind.

    Args:
        path: File that `MapPrior.save` or `GaussianPrior.save` has written. It may be untrusted.
        update: Reserve the file of a `MapPrior` for this process, to save it later.

    Returns:
        The prior. `MapPrior.close` releases its file; a `GaussianPrior` holds none.

    Raises:
        ValueError: If the file is no valid prior.
        RuntimeError: If the file is reserved by another process.
    """
    path = Path(path)
    with path.open("rb") as file:
        is_gaussian = file.read(len(GAUSSIAN_MAGIC)) == GAUSSIAN_MAGIC
    if is_gaussian:
        return GaussianPrior.load(path)
    return MapPrior.load(path, update=update)
