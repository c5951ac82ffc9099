"""VectorMapNet's metric: AP_chamfer without the samples that lack predictions or ground truth."""

from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from gsmap.evaluation.core.chamfer_ap import ChamferConfig
from gsmap.evaluation.core.matches import FrameMatches
from gsmap.evaluation.core.metric import MetricSettings, Sample, register_metric
from gsmap.structures.elements import MapElements
from gsmap.structures.grid import BEVGrid
from gsmap.utils.errors import InputError

MARGIN_M = 2.0  # added to the extent by the released code, see `_shrink`


@register_metric
@dataclass(frozen=True)
class VectorMapNetAP(ChamferConfig):
    """AP_chamfer at 0.5, 1.0 and 1.5 m.

    Samples without predictions or without ground truth are not counted.
    """

    name: ClassVar[str] = "vectormapnet"
    companions: ClassVar[tuple[str, ...]] = ("chamfer",)  # metrics reported before it
    takes_thresholds: ClassVar[bool] = False

    @classmethod
    def from_settings(cls, settings: MetricSettings) -> "VectorMapNetAP":
        """Create the metric from the settings of a command or config.

        Raises:
            ValueError: If the settings ask for heights or for lines that are not resampled.
        """
        resamples = settings.resample_predictions and settings.resample_ground_truth
        if settings.dim != 2 or not resamples:
            raise InputError(
                f"{cls.name} is AP_chamfer of lines in the plane that are resampled to 100 points: "
                "set dim=2, and let predictions and ground truth be resampled."
            )
        return cls(settings.classes)

    def match(self, sample: Sample) -> FrameMatches:
        """Match one sample; the matches are empty without predictions or without ground truth."""
        return super().match(sample).empty_if_one_sided()


@register_metric
@dataclass(frozen=True)
class ShrunkVectorMapNetAP(VectorMapNetAP):
    """`VectorMapNetAP` of maps that are scaled down as in the released code.

    The released code normalises coordinates with a margin of 2 m, but restores them without it.

    Args:
        grid: Extent of the map, in metres, by which predictions and ground truth are scaled.
    """

    name: ClassVar[str] = "vectormapnet_shrunk"

    grid: BEVGrid = field(kw_only=True)

    @classmethod
    def from_settings(cls, settings: MetricSettings) -> "ShrunkVectorMapNetAP":
        """Create the metric from the settings of a command or config.

        Raises:
            ValueError: If the settings ask for heights or for lines that are not resampled, or have
                no extent of the map.
        """
        plain = VectorMapNetAP.from_settings(settings)  # checks the settings
        return cls(plain.classes, grid=settings.canvas)

    def match(self, sample: Sample) -> FrameMatches:
        """Match one sample after scaling down both sides."""
        predictions = _shrink(sample.predictions, self.grid)
        ground_truth = _shrink(sample.ground_truth, self.grid)
        return super().match(
            Sample(sample.token, predictions=predictions, ground_truth=ground_truth)
        )


def _shrink(elements: MapElements, grid: BEVGrid) -> MapElements:
    """Scale elements down as in the released code.

    The released code divides coordinates by the extent of the map plus 2 m and multiplies them by
    the extent alone. Here elements are scaled about another origin, which does not change
    distances.
    """
    size = np.array(grid.extent_m)  # lengths along x and y, in metres
    points = elements.with_coordinates(2).points * (size / (size + MARGIN_M))
    return replace(elements, points=points)
