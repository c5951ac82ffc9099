"""Rules of merging, and how certain a predicted vertex is."""

from dataclasses import dataclass

import numpy as np

from drivemaps.drive import DriveFrame
from gsmap.structures.elements import FloatArray

NEAR_SIGMA_M = 0.2  # where results carry no Gaussians
SIGMA_PER_M = 0.02  # of the distance from the vehicle


@dataclass(frozen=True)
class MergeConfig:
    """Rules of merging.

    Args:
        gaussians: Weigh by the vertices' Gaussians where the results carry them.
        min_confidence: Vertices of lines with less are left out (``merge_lines`` defines it).
        min_area_confidence: Areas with less are left out; models find them from nearby only.
    """

    gaussians: bool = True
    min_confidence: float = 0.25
    min_area_confidence: float = 0.1

    def variances(self, frame: DriveFrame) -> FloatArray:
        """Return the variance of each predicted vertex across its line, in square metres. (M,)

        It is that of the vertices' Gaussians, or of a fixed deviation, plus a part that grows with
        the distance from the vehicle.
        """
        elements = frame.elements
        distances = np.linalg.norm(frame.to_frame(elements.points), axis=1)
        far = (SIGMA_PER_M * distances) ** 2
        if not (self.gaussians and elements.has_gaussians):
            return NEAR_SIGMA_M**2 + far
        import torch  # only Gaussians need it

        from gsmap.structures.gaussians import Gaussians, extents_along_line

        values = map(torch.from_numpy, (elements.points, elements.scales, elements.rotations))
        counts = elements.num_points.tolist()
        lines = zip(*(value.split(counts) for value in values), strict=True)
        across = [extents_along_line(Gaussians(*line))[:, 1] for line in lines]
        return np.concatenate([np.zeros(0), *across]) ** 2 + far
