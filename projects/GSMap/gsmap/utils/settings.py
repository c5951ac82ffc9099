"""Checks of settings that many parts have."""

from gsmap.utils.errors import InputError


def check_positive(**values: float) -> None:
    """Raise ValueError if a number is not more than 0; its name is that in the message."""
    for name, value in values.items():
        if not value > 0:
            raise InputError(f"{name} must be more than 0, got {value}.")
