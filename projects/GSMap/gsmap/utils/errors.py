"""Errors that a user can cause. A command prints their text; every other exception is a bug.

Each class is also the exception of Python that the docstrings name (``Raises: ValueError``), so a
caller needs to know none of them.
"""


class GsmapError(Exception):
    """Base class of the errors whose text is written for the user: the fault and its remedy."""


class InputError(GsmapError, ValueError):
    """An argument, a file or a setting has a value that cannot be used."""


class InputTypeError(GsmapError, TypeError):
    """An argument or a setting has a type that cannot be used."""


class WorkError(GsmapError, RuntimeError):
    """The work cannot be done here: a package, a device or another process prevents it."""


class NotFiniteError(GsmapError, FloatingPointError):
    """Losses, costs or weights are NaN or infinite."""
