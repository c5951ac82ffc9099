"""Settings of a Gaussian prior, a map of earlier drives that stores Gaussians along lines.

A Gaussian counts hits and misses. A frame that has it in view adds p to its hits and 1 - p to its
misses, where p is the score of the line that measures it, or 0 without such a line. The value of a
Gaussian is hits / (hits + misses + ``prior_count``).
"""

from dataclasses import dataclass

from gsmap.utils.errors import InputError


@dataclass(frozen=True)
class GaussianRule:
    """Settings of the Gaussians of a prior and of their update.

    Args:
        spacing_m: Distance between new Gaussians along a line, in [0.2, 5] metres. The standard
            deviation of a Gaussian along its line is half of this distance.
        sigma_m: Standard deviation across the line for predictions of a model without Gaussians, in
            [0.01, 5] metres.
        least_sigma_m: Smallest standard deviation of a Gaussian across its line, in [0.001, 1]
            metres, which covers the errors that all frames share.
        line_sigma_m: Standard deviation of a drawn line across its direction, in [0.05, 2] metres.
        decay: Factor in [0.5, 1] by which older data lose weight. Each frame that has the Gaussian
            in view multiplies the older hits and misses by it. Each line that measures the Gaussian
            multiplies the inverse of the older variance across the line by it.
        prior_count: Number of misses that is added in the value of a Gaussian, in [0.01, 100]. It
            lowers the value of Gaussians that few frames have had in view.
        least_value: Smallest value of a Gaussian that is drawn, in [0, 1].

    Raises:
        ValueError: If a setting is out of range.
    """

    spacing_m: float = 1.0
    sigma_m: float = 0.2
    least_sigma_m: float = 0.05
    line_sigma_m: float = 0.2
    decay: float = 0.95
    prior_count: float = 0.25
    least_value: float = 0.4

    def __post_init__(self) -> None:
        ranges = {
            "spacing_m": (0.2, 5.0),
            "sigma_m": (0.01, 5.0),
            "least_sigma_m": (0.001, 1.0),
            "line_sigma_m": (0.05, 2.0),
            "decay": (0.5, 1.0),
            "prior_count": (0.01, 100.0),
            "least_value": (0.0, 1.0),
        }
        for name, (low, high) in ranges.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise InputError(f"{name} must be in [{low:g}, {high:g}], got {value}.")


GAUSSIAN_RULES: dict[str, type] = {"gaussians": GaussianRule}
"""Classes of the settings of Gaussian priors, by the name of the kind of prior in files."""
