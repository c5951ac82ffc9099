"""Errors in the files of a data set, with the name of the file."""

from collections.abc import Iterator
from contextlib import contextmanager

import pyarrow as pa
import shapely

from gsmap.utils.errors import InputError
from gsmap.utils.faults import is_machine_error


class BrokenSampleError(InputError):
    """Error for a sample with a file that is missing, damaged or empty.

    A data set with ``broken_samples="raise"`` raises the error. With ``"skip"``, it skips the
    sample and counts it.
    """


# Errors that damaged or malformed content can cause.
_CONTENT_ERRORS = (
    LookupError, TypeError, ValueError, AttributeError, ArithmeticError, AssertionError,
    RecursionError, pa.ArrowException, shapely.errors.ShapelyError,
)  # fmt: skip


@contextmanager
def explain_errors(subject: object, remedy: str) -> Iterator[None]:
    """Context manager that adds the name of a file and a remedy to errors about its content.

    Three kinds of errors are not changed: errors of the system, such as a lack of memory or a
    missing file; errors whose message already contains the name; and errors that content does not
    cause.

    Args:
        subject: Path or name of the data, with which the message begins.
        remedy: Advice to the user, with which the message ends.

    Raises:
        ValueError: If the ``with`` block raises an error that the content of a file can cause,
            such as an error of indexing, arithmetic or a parser.
    """
    try:
        yield
    except Exception as error:
        from_devkit = type(error) is Exception  # nuScenes' devkit raises plain `Exception`
        from_arrow = type(error) is OSError and error.errno is None  # Arrow, for a damaged file
        is_about_content = isinstance(error, _CONTENT_ERRORS) or from_devkit or from_arrow
        has_name = str(subject) in str(error)
        if has_name or not is_about_content or is_machine_error(error):
            raise
        # The messages of ValueError and OSError are sentences. The messages of most other errors
        # are clear only with the name of their class.
        reason = str(error)
        if isinstance(error, KeyError):  # its message is only the key
            reason = f"it has no {error}"
        elif not isinstance(error, (ValueError, OSError)) and not from_devkit:
            reason = f"{type(error).__name__}: {error}"
        reason = reason.rstrip(".")
        # An inner context of this kind may already have added the remedy.
        advice = "" if reason.endswith(remedy) else f"; {remedy}"
        raise InputError(f"{subject} cannot be used: {reason}{advice}.") from error
