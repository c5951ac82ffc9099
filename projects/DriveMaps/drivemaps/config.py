"""Parameters of merging the predictions of a drive's frames into one map."""

from dataclasses import dataclass

import numpy as np

from drivemaps.drive import DriveFrame
from gsmap.structures.elements import FloatArray

NEAR_SIGMA_M = 0.2  # standard deviation of vertices without Gaussians, near the vehicle
SIGMA_PER_M = 0.02  # additional standard deviation per metre of distance from the vehicle


@dataclass(frozen=True)
class MergeConfig:
    """Parameters of merging the predictions of a drive's frames into one map.

    Args:
        gaussians: Whether the weights of vertices come from their Gaussians, where the results have
            Gaussians.
        min_confidence: Smallest confidence of a vertex of a line in the map, in [0, 1]. The
            confidence is the sum of the scores of the frames with a line there, divided by the
            number of frames with the vertex in their range (``merge_lines``).
        min_area_confidence: Smallest confidence of an area in the map, in [0, 1], computed in the
            same way at each spot of the area (``merge_areas``). It is lower than for lines, because
            models detect areas only from nearby.
    """

    gaussians: bool = True
    min_confidence: float = 0.25
    min_area_confidence: float = 0.1

    def variances(self, frame: DriveFrame) -> FloatArray:
        """Compute the variance of each predicted vertex across its line.

        A vertex with a smaller variance has more weight in the map. The variance is the sum of two
        terms: the variance of the vertex's Gaussian across the line (a constant without Gaussians),
        and a term that grows with the distance from the vehicle.

        Args:
            frame: Frame with its predictions.

        Returns:
            Variance of each of the M vertices, in square metres. (M,)
        """
        elements = frame.elements
        # The vertices are in the global frame. Their distance from the vehicle is their distance
        # from the origin of the annotation frame.
        distances = np.linalg.norm(frame.to_frame(elements.points), axis=1)
        far = (SIGMA_PER_M * distances) ** 2
        if not (self.gaussians and elements.has_gaussians):
            return NEAR_SIGMA_M**2 + far
        import torch  # imported here, because it loads slowly and only Gaussians need it

        from gsmap.structures.gaussians import Gaussians, extents_along_line

        counts = elements.num_points.tolist()
        means = torch.from_numpy(elements.points).split(counts)
        scales = torch.from_numpy(elements.scales).split(counts)
        rotations = torch.from_numpy(elements.rotations).split(counts)
        sigmas = [np.zeros(0)]  # for a frame without lines, as `concatenate` needs an array
        for line_means, line_scales, line_rotations in zip(means, scales, rotations, strict=True):
            gaussians = Gaussians(line_means, scales=line_scales, rotations=line_rotations)
            _, across = extents_along_line(gaussians).unbind(-1)  # along and across the line
            sigmas.append(across.numpy())
        return np.concatenate(sigmas) ** 2 + far
