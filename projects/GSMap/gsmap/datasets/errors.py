"""What may be wrong with the files of a data set, said with their names."""

from collections.abc import Iterator
from contextlib import contextmanager

import pyarrow as pa
import shapely

from gsmap.utils.errors import InputError
from gsmap.utils.faults import is_of_the_machine


class BrokenSampleError(InputError):
    """A sample cannot be used because one of its files is missing, damaged or empty.

    The data set raises it on, or skips and counts the sample, as its option ``broken_samples``
    says.
    """


_UNEXPECTED = (
    LookupError, TypeError, ValueError, AttributeError, ArithmeticError, AssertionError,
    RecursionError, pa.ArrowException, shapely.errors.ShapelyError,
)  # fmt: skip


@contextmanager
def naming(what: object, remedy: str) -> Iterator[None]:
    """Say whose content is meant, and what to do, where reading it meets with something unexpected.

    Raises:
        ValueError: In place of what indexing, arithmetic or a parser raises in the block.
    """
    try:
        yield
    except Exception as error:
        expected = isinstance(error, _UNEXPECTED) or type(error) is Exception  # nuScenes' devkit
        of_arrow = type(error) is OSError and error.errno is None
        if is_of_the_machine(error) or not (expected or of_arrow) or str(what) in str(error):
            raise
        reason = str(error)
        if isinstance(error, KeyError):
            reason = f"it has no {error}"
        elif not isinstance(error, (ValueError, OSError)) and type(error) is not Exception:
            reason = f"{type(error).__name__}: {error}"
        advice = "" if reason.rstrip(".").endswith(remedy) else f"; {remedy}"
        raise InputError(f"{what} cannot be used: {reason.rstrip('.')}{advice}.") from error
