"""Checks of settings that many parts have."""


def check_positive(**values: float) -> None:
    """Raise ValueError if a number is not more than 0; its name is that in the message."""
    for name, value in values.items():
        if not value > 0:
            raise ValueError(f"{name} must be more than 0, got {value}.")
