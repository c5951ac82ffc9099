"""Settings of a prior of elements, a map of earlier drives that stores whole map elements."""

from dataclasses import dataclass

from gsmap.utils.errors import InputError


@dataclass(frozen=True)
class ElementRule:
    """Settings of the elements of a prior.

    Args:
        sigma_m: Standard deviation of the points of an element across its line, in [0.01, 5]
            metres.
        line_width_m: Width of the lines when elements are drawn to the raster of a frame, in
            [0.05, 5] metres.

    Raises:
        ValueError: If a setting is out of range.
    """

    sigma_m: float = 0.2
    line_width_m: float = 0.6

    def __post_init__(self) -> None:
        for name, low in (("sigma_m", 0.01), ("line_width_m", 0.05)):
            value = getattr(self, name)
            if not low <= value <= 5.0:
                raise InputError(f"{name} must be in [{low:g}, 5], got {value}.")


ELEMENT_RULES: dict[str, type] = {"elements": ElementRule}
"""Classes of the settings of priors of elements, by the name of the kind of prior in files."""
