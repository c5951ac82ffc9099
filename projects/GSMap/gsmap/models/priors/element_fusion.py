"""Fusion of detections with the elements of earlier drives.

An `ElementPrior` is a map of earlier drives. It stores elements in the global frame of a place,
such as a town. Each element has a class and a confidence.
"""

import logging
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from mmdet3d.registry import MODELS
from mmengine.logging import print_log
from mmengine.structures import InstanceData
from torch import Tensor

from gsmap.models.priors.prior_module import PriorModule
from gsmap.prior.element_prior import ElementPrior
from gsmap.prior.opening import AnyPrior
from gsmap.prior.places import GivenMaps, Place
from gsmap.structures.elements import MapElements
from gsmap.structures.gaussians import gaussians_along
from gsmap.structures.line_update import nearest_places
from gsmap.structures.polylines import resample_all
from gsmap.utils.errors import InputError

# Side of the cells of `PriorModule.window`. Elements need no cells: only the extent of the window
# is used here.
_CELL_M = 0.3


@MODELS.register_module()
class ElementFusion(PriorModule):
    r"""Fusion of detections with the elements of an `ElementPrior` at the pose of a frame.

    A detection belongs to the nearest element of its class within ``gate_m``. An element gets the
    score

    .. math:: 1 - (1 - c\,(m + (1 - m)\,s))\,(1 - s)

    where c is its confidence, s is the best score of its detections (0 without a detection), and m
    is ``missed_share``. The element replaces its detections, because the mean of many frames is
    more accurate than one frame. All other detections stay as they are. The module has no weights
    and needs no training, so any trained model with a `MapHead` can use it. Without a prior, the
    detections do not change, and a warning is logged. This module is not part of a published
    method.

    Args:
        head: Head of the detector, a `MapHead`.
        encoder: BEV encoder of the detector, which is not used.
        gate_m: Largest distance between a detection and an element that belong together, in metres.
            The distance is the larger of two means: the mean distance of the points of the
            detection to the element, and of the points of the element to the detection.
        missed_share: Share of its confidence that an element without a detection keeps, in [0, 1].
        init_cfg: Initialisation config of mmengine.

    Raises:
        ValueError: If the head is no `MapHead`, or a setting is out of range.
    """

    def __init__(
        self,
        head: Any,
        encoder: Any = None,
        gate_m: float = 1.5,
        missed_share: float = 0.5,
        init_cfg: dict | None = None,
    ) -> None:
        super().__init__(head, cell_m=_CELL_M, init_cfg=init_cfg)
        if not (gate_m > 0 and 0 <= missed_share <= 1):
            raise InputError(
                "ElementFusion needs gate_m > 0 and missed_share in [0, 1], got "
                f"{gate_m} and {missed_share}."
            )
        self.num_points = head.num_points
        self.has_gaussians = "scales" in head.reference.outputs
        self.gate_m = gate_m
        self.missed_share = missed_share
        self._has_warned = False

    def maps_of(self, priors: Sequence[AnyPrior], update: bool = False) -> GivenMaps:
        """Check the priors of a user, and prepare them as `PriorModule.maps_of` does.

        Args:
            priors: The priors, one for each place.
            update: Whether to write each frame to the priors, which an `ElementPrior` refuses.

        Returns:
            The maps, as arguments of `PriorModule.use`.

        Raises:
            ValueError: If a prior is no `ElementPrior`, has other classes, or is to be written.
        """
        for prior in priors:
            if not isinstance(prior, ElementPrior):
                raise InputError(
                    f"the prior of {prior.settings.place!r} has no elements, which ElementFusion "
                    "needs: make one by tools/build_map.py --prior FILE --elements."
                )
        return super().maps_of(priors, update=update)

    def update_detections(
        self, results: Sequence[InstanceData], metas: Sequence[Mapping[str, Any]]
    ) -> list[InstanceData]:
        """Fuse the detections of a batch with the elements at their places.

        Args:
            results: Detections of each sample, as predicted by the head.
            metas: Metainfo of each sample, with its pose ``lidar2global`` and ``map_name``.

        Returns:
            Detections of each sample, highest score first. Without a prior, these are ``results``.

        Raises:
            ValueError: If the place of a sample is unknown or has no prior, or if detections have
                heights or fields that elements do not have.
        """
        maps = self._given  # set by `PriorModule.use`; `GivenMaps` are the priors of a user
        if not isinstance(maps, GivenMaps):
            self._warn_once()
            return list(results)
        updated = []
        for detections, meta in zip(results, metas, strict=True):
            place = maps.require_place(Place.of(meta))  # an error if the sample has no pose
            prior = maps.find(place)  # an error if no prior is of this place
            assert isinstance(prior, ElementPrior)  # `maps_of` has checked it
            # The elements are cut at the window and are in the annotation frame of the sample.
            elements = prior.read_elements(place.pose, self.window)
            prior.reads.add(is_empty=len(elements) == 0)
            updated.append(self._fuse_sample(detections, elements, sigma_m=prior.rule.sigma_m))
        return updated

    def _warn_once(self) -> None:
        """Log that there is no prior, at the first batch without one."""
        if not self._has_warned:
            print_log(
                "ElementFusion has no prior, so detections stay as they are: give one (--prior).",
                logger="current",
                level=logging.WARNING,
            )
        self._has_warned = True

    def _fuse_sample(
        self, detections: InstanceData, elements: MapElements, sigma_m: float
    ) -> InstanceData:
        """Fuse the detections of one sample.

        Args:
            detections: Detections of the head.
            elements: Elements of the prior in the range of the sample, in its annotation frame.
            sigma_m: Standard deviation of the points of elements across their lines, in metres.

        Returns:
            The E elements and the detections that belong to none of them, highest score first.

        Raises:
            ValueError: If detections have heights or fields that elements do not have.
        """
        if not len(elements):
            return detections
        points = detections.pts
        if points.shape[-1] != 2:
            raise InputError(
                "ElementFusion needs detections without heights, as elements have none: leave out "
                "model.prior."
            )
        resampled = resample_all(elements.points, elements.offsets, num_points=self.num_points)
        lines = torch.from_numpy(resampled).to(points)  # (E, P, 2)
        labels = torch.from_numpy(elements.labels).to(detections.labels_3d)
        confidences = torch.from_numpy(elements.confidence).to(detections.scores_3d)
        distances = _distances(points, labels=detections.labels_3d, lines=lines, line_labels=labels)
        smallest_m, element_inds = distances.min(1)  # nearest element of each detection (N,)
        belongs = smallest_m < self.gate_m
        matched_scores = torch.where(belongs, detections.scores_3d, 0.0)
        best_scores = torch.zeros_like(confidences)
        # Largest score of the detections of each element, 0 for an element without detections.
        best_scores.scatter_reduce_(0, element_inds, matched_scores, reduce="amax")
        # The formula of the class, with the shares m + (1 - m) s.
        shares = self.missed_share + (1 - self.missed_share) * best_scores
        scores = 1 - (1 - shares * confidences) * (1 - best_scores)
        fields = {"pts": lines, "labels_3d": labels, "scores_3d": scores}
        if self.has_gaussians:
            # Along a line, sigmas follow from the distances of its points.
            gaussians = gaussians_along(lines, across_m=sigma_m)
            fields["scales"] = gaussians.scales.to(detections.scales)
            fields["rotations"] = gaussians.rotations.to(detections.rotations)
        # Every field of the detections must be filled for the elements as well.
        unknown = sorted(set(detections.keys()) - set(fields))
        if unknown:
            raise InputError(
                f"ElementFusion cannot make {unknown[0]!r} of detections for elements: leave out "
                "model.prior."
            )
        others = detections[~belongs]
        joined = {}
        for name, values in fields.items():
            joined[name] = torch.cat([values, others[name]])
        order = joined["scores_3d"].argsort(descending=True)
        fused = {name: values[order] for name, values in joined.items()}
        return InstanceData(metainfo=dict(detections.metainfo_items()), **fused)


def _distances(points: Tensor, labels: Tensor, lines: Tensor, line_labels: Tensor) -> Tensor:
    """Compute the distances between detections and elements of equal class.

    Args:
        points: Points of the detections in metres. (N, P, 2)
        labels: Classes of the detections. (N,)
        lines: Points of the elements in metres. (E, P, 2)
        line_labels: Classes of the elements. (E,)

    Returns:
        For each pair the larger of two means: the mean distance of the points of the detection to
        the line of the element, and of the points of the element to the line of the detection.
        Infinite if the classes differ. (N, E)
    """
    # Distances are computed only for the pairs of equal class.
    rows, columns = (labels[:, None] == line_labels).nonzero(as_tuple=True)
    # `nearest_places` finds the nearest position on a line for each point, with its distance.
    to_lines = nearest_places(points[rows], lines[columns]).distances.mean(-1)
    to_detections = nearest_places(lines[columns], points[rows]).distances.mean(-1)
    distances = points.new_full((len(labels), len(line_labels)), torch.inf)
    distances[rows, columns] = torch.maximum(to_lines, to_detections)
    return distances
