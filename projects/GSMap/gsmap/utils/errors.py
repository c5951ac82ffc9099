"""Errors that a user can cause. A command prints their text; every other exception is a bug.

Each class derives from the built-in exception that the docstrings name (``Raises: ValueError``), so
callers can catch the built-in one.
"""


class GsmapError(Exception):
    """Base class of errors with a text for the user, which names the fault and a remedy."""


class InputError(GsmapError, ValueError):
    """Invalid value of an argument, a file or a setting."""


class InputTypeError(GsmapError, TypeError):
    """Invalid type of an argument or a setting."""


class WorkError(GsmapError, RuntimeError):
    """Work that a missing package, a device or another process prevents."""


class NotFiniteError(GsmapError, FloatingPointError):
    """NaN or infinite losses, costs or weights."""
