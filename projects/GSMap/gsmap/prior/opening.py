"""Opening of the files of all kinds of priors."""

from pathlib import Path

from gsmap.prior.element_prior import ElementPrior
from gsmap.prior.file_format import ELEMENT_MAGIC, GAUSSIAN_MAGIC
from gsmap.prior.gaussian_prior import GaussianPrior
from gsmap.prior.map_prior import MapPrior

AnyPrior = MapPrior | GaussianPrior | ElementPrior
"""Priors that a model reads: a raster of the classes, Gaussians, or map elements."""


def open_prior(path: str | Path, update: bool = False) -> AnyPrior:
    """Open the file of a prior. The first bytes of the file determine the kind of prior.

    Args:
        path: File that `MapPrior.save`, `GaussianPrior.save` or `ElementPrior.save` has written. It
            may be untrusted.
        update: Reserve the file of a `MapPrior` for this process, to save it later.

    Returns:
        The prior. `MapPrior.close` releases its file; other kinds of priors reserve no file.

    Raises:
        FileNotFoundError: If the file does not exist.
        ValueError: If the file is not a valid prior.
        RuntimeError: If the file is to be reserved, and another process has reserved it.
    """
    path = Path(path)
    with path.open("rb") as file:
        magic = file.read(len(GAUSSIAN_MAGIC))  # all kinds have a mark of this length
    if magic == GAUSSIAN_MAGIC:
        return GaussianPrior.load(path)
    if magic == ELEMENT_MAGIC:
        return ElementPrior.load(path)
    return MapPrior.load(path, update=update)  # refuses a file that is no prior
