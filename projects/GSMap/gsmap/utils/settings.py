"""Checks of numbers in settings."""

from gsmap.utils.errors import InputError


def check_positive(**values: float) -> None:
    """Require positive numbers.

    Args:
        **values: Numbers, by the names for the message.

    Raises:
        ValueError: If a number is not greater than 0.
    """
    for name, value in values.items():
        if not value > 0:
            raise InputError(f"{name} must be more than 0, got {value}.")
