"""Memory of elements: what was detected in a frame says where it lies in the next."""

import math
from collections.abc import Sequence
from typing import Any

import torch
from mmdet3d.registry import MODELS
from mmengine.structures import InstanceData
from torch import Tensor

from gsmap.models.base.head import MapHead
from gsmap.structures.gaussians import Gaussians, moved_gaussians
from gsmap.structures.line_update import seen_again
from gsmap.structures.past import Past
from gsmap.utils.errors import InputError

PREFIX = "element_"


@MODELS.register_module()
class ElementMemory:
    """Update the detections of a frame by those of the frame before (`seen_again`).

    The elements before are moved by the vehicle's motion, and their covariances grow by its noise.
    It has no weights and takes no part in training, so it suits every trained model that predicts
    Gaussians. This is ours.

    Args:
        head: The detector's head, whose detections have ``scales`` and ``rotations``.
        gate_m: Largest distance, in metres, at which an element is one seen before.
        min_score: Smallest score of the elements that are updated and remembered.
        noise_m: How far the motion of one second is off, standard deviation in metres; the variance
            grows with the time.
        noise_deg: The same for the vehicle's heading, in degrees.

    Raises:
        ValueError: If the head has no Gaussians, or a setting is out of its range.
    """

    def __init__(
        self,
        head: Any,
        gate_m: float = 3.0,
        min_score: float = 0.05,
        noise_m: float = 0.05,
        noise_deg: float = 0.15,
    ) -> None:
        if not isinstance(head, MapHead) or "scales" not in head.reference.outputs:
            raise InputError(
                f"temporal.elements needs a head with Gaussians, got {type(head).__name__}: take "
                "GSMapHead, or leave it out."
            )
        if not (gate_m > 0 and 0 <= min_score < 1 and noise_m >= 0 and noise_deg >= 0):
            raise InputError(
                "temporal.elements needs gate_m > 0, min_score in [0, 1), noise_m and noise_deg "
                f">= 0, got {gate_m}, {min_score}, {noise_m} and {noise_deg}."
            )
        self.num = head.coder.max_num
        self.gate_m, self.min_score = gate_m, min_score
        self.noise_m, self.noise_rad = noise_m, math.radians(noise_deg)

    def updated(self, results: Sequence[InstanceData], past: Past) -> list[InstanceData]:
        """Return a batch's detections, as the head predicts them, with updated Gaussians."""
        if f"{PREFIX}labels" not in past.memory:
            return list(results)
        labels = past.memory[f"{PREFIX}labels"]
        known = Gaussians(*(past.memory[f"{PREFIX}{name}"] for name in Gaussians._fields))
        spread = past.seconds.sqrt()
        drift = self.noise_m * spread, self.noise_rad * spread
        moved = moved_gaussians(known, past.now_from_then, *drift)
        return [
            self._update(found, Gaussians(*(values[index] for values in moved)), labels[index])
            if goes_on
            else found
            for index, (found, goes_on) in enumerate(
                zip(results, past.continues.tolist(), strict=True)
            )
        ]

    def _update(self, found: InstanceData, known: Gaussians, labels: Tensor) -> InstanceData:
        """Update one sample's detections by the elements of non-negative labels."""
        kept, own = labels >= 0, found.scores_3d >= self.min_score
        now = gaussians_of(found)
        new = seen_again(
            Gaussians(*(values[own] for values in now)),
            found.labels_3d[own],
            Gaussians(*(values[kept] for values in known)),
            labels[kept],
            self.gate_m,
        )
        means, scales, rotations = (
            old.index_put((own,), values) for old, values in zip(now, new, strict=True)
        )
        result = found.clone()
        result.pts = torch.cat([means, found.pts[..., 2:]], -1)
        result.scales, result.rotations = scales, rotations
        return result

    def left(self, results: Sequence[InstanceData]) -> dict[str, Tensor]:
        """Return what a batch's detections leave, by name. (B, max_num, ...)"""
        frames = []
        for found in results:
            own = found.scores_3d >= self.min_score
            values = [found.labels_3d[own] + 1, *(part[own] for part in gaussians_of(found))]
            rows = [part.new_zeros(self.num, *part.shape[1:]) for part in values]
            for row, part in zip(rows, values, strict=True):
                row[: len(part)] = part
            frames.append([rows[0] - 1, *rows[1:]])  # label -1: no element
        names = ["labels", *Gaussians._fields]
        return {
            f"{PREFIX}{name}": torch.stack(parts)
            for name, parts in zip(names, zip(*frames, strict=True), strict=True)
        }


def gaussians_of(found: InstanceData) -> Gaussians:
    """Return the Gaussians of a sample's detections, in the plane. (N, P)"""
    return Gaussians(found.pts[..., :2].float(), found.scales.float(), found.rotations.float())
