"""VectorMapNet's metric: AP_chamfer of the samples that have predictions and ground truth."""

from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from gsmap.evaluation.core.chamfer_ap import ChamferConfig
from gsmap.evaluation.core.matches import FrameMatches
from gsmap.evaluation.core.metric import MetricSettings, Sample, register_metric
from gsmap.structures.elements import MapElements
from gsmap.structures.grid import BEVGrid

SHRUNK_MARGIN_M = 2.0


@register_metric
@dataclass(frozen=True)
class VectorMapNetAP(ChamferConfig):
    """AP_chamfer at 0.5, 1.0 and 1.5 m without the samples that lack either side."""

    name: ClassVar[str] = "vectormapnet"
    beside: ClassVar[tuple[str, ...]] = ("chamfer",)

    @classmethod
    def of(cls, settings: MetricSettings) -> "VectorMapNetAP":
        """Return the metric by the settings of a command or config.

        Raises:
            ValueError: If they are about heights or points as they are given.
        """
        given = settings.resample_predictions, settings.resample_ground_truth
        if settings.dim != 2 or not all(given):
            raise ValueError(
                f"{cls.name} is AP_chamfer of lines of 100 points in the plane: leave out "
                "heights (dim 3) and points as they are given."
            )
        return cls(settings.classes)

    def match(self, sample: Sample) -> FrameMatches:
        """Match one sample; one that lacks a side is empty."""
        return super().match(sample).if_two_sided()


@register_metric
@dataclass(frozen=True)
class ShrunkVectorMapNetAP(VectorMapNetAP):
    """The metric in the units of its release, where a map is smaller as its canvas is larger.

    Args:
        grid: Extent of the map, by which both sides are scaled.
    """

    name: ClassVar[str] = "vectormapnet_shrunk"

    grid: BEVGrid = field(kw_only=True)

    @classmethod
    def of(cls, settings: MetricSettings) -> "ShrunkVectorMapNetAP":
        """Return the metric by the settings of a command or config."""
        plain = VectorMapNetAP.of(settings)
        return cls(plain.classes, grid=settings.canvas)

    def match(self, sample: Sample) -> FrameMatches:
        """Match one sample in those units."""
        found = _in_shrunk_units(sample.predictions, self.grid)
        truth = _in_shrunk_units(sample.ground_truth, self.grid)
        return super().match(Sample(sample.token, found, truth))


def _in_shrunk_units(elements: MapElements, grid: BEVGrid) -> MapElements:
    """Return elements of a map in the units of VectorMapNet's release.

    There coordinates are a share of the map and 2 m more, and come back as that share of the map
    alone. It matters to distances that they are scaled so, not from which corner.
    """
    size = np.array(grid.extent_m)
    points = elements.with_coordinates(2).points * (size / (size + SHRUNK_MARGIN_M))
    return replace(elements, points=points)
