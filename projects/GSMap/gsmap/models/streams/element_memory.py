"""Memory of elements: refinement of detections by the detections of the previous frame."""

import math
from collections.abc import Sequence
from typing import Any

import torch
from mmdet3d.registry import MODELS
from mmengine.structures import InstanceData
from torch import Tensor

from gsmap.models.base.head import MapHead
from gsmap.structures.gaussians import Gaussians, move_gaussians
from gsmap.structures.line_update import update_from_known_lines
from gsmap.structures.past import Past
from gsmap.utils.errors import InputError

PREFIX = "element_"  # begins the names of remembered elements in the memory of a stream


@MODELS.register_module()
class ElementMemory:
    """Update of detections by the elements of the previous frame (`update_from_known_lines`).

    The previous elements are transformed by the ego motion, and their covariances grow by the noise
    of the motion. The update has no weights and needs no training, so any trained model with
    Gaussians can use it. It is not part of a published method.

    Args:
        head: Head of the detector; its detections have ``scales`` and ``rotations``.
        gate_m: Largest distance between a detection and a previous element that match, in metres.
        min_score: Smallest score of elements that are updated and remembered.
        noise_m: Standard deviation of the error of the ego translation after one second, in metres.
            The variance is proportional to the time.
        noise_deg: Standard deviation of the error of the ego heading after one second, in degrees.

    Raises:
        ValueError: If the head has no Gaussians, or a setting is out of range.
    """

    def __init__(
        self,
        head: Any,
        gate_m: float = 3.0,
        min_score: float = 0.05,
        noise_m: float = 0.05,
        noise_deg: float = 0.15,
    ) -> None:
        # A head's reference decodes the predictions to the fields in its `outputs`. Only Gaussians
        # have the field ``scales``.
        if not isinstance(head, MapHead) or "scales" not in head.reference.outputs:
            raise InputError(
                f"temporal.elements needs a head with Gaussians, got {type(head).__name__}: take "
                "GSMapHead, or leave out temporal.elements."
            )
        has_valid_noise = noise_m >= 0 and noise_deg >= 0
        if not (gate_m > 0 and 0 <= min_score < 1 and has_valid_noise):
            raise InputError(
                "temporal.elements needs gate_m > 0, min_score in [0, 1), noise_m and noise_deg "
                f">= 0, got {gate_m}, {min_score}, {noise_m} and {noise_deg}."
            )
        self.num = head.coder.max_num  # largest number of detections of a sample
        self.gate_m = gate_m
        self.min_score = min_score
        self.noise_m = noise_m
        self.noise_rad = math.radians(noise_deg)

    def update_detections(self, results: Sequence[InstanceData], past: Past) -> list[InstanceData]:
        """Update the Gaussians of a batch of detections.

        Args:
            results: Detections of each sample, as predicted by the head.
            past: Memory of the streams, with the tensors of `remember`, and the ego motion.

        Returns:
            Detections of each sample, unchanged if its stream starts or the memory is empty.
        """
        if f"{PREFIX}labels" not in past.memory:  # all streams start
            return list(results)
        labels = past.memory[f"{PREFIX}labels"]
        remembered = Gaussians(
            means=past.memory[f"{PREFIX}means"],
            scales=past.memory[f"{PREFIX}scales"],
            rotations=past.memory[f"{PREFIX}rotations"],
        )
        sqrt_seconds = past.seconds.sqrt()  # a standard deviation grows with the root of the time
        previous = move_gaussians(
            remembered,
            motion=past.now_from_then,
            drift_m=self.noise_m * sqrt_seconds,
            drift_rad=self.noise_rad * sqrt_seconds,
        )
        updated = []
        for index, continues in enumerate(past.continues.tolist()):
            detections = results[index]
            if continues:
                detections = self._update_sample(
                    detections, previous=_select(previous, index), labels=labels[index]
                )
            updated.append(detections)
        return updated

    def _update_sample(
        self, detections: InstanceData, previous: Gaussians, labels: Tensor
    ) -> InstanceData:
        """Update the detections of one sample. Previous elements with label -1 are padding."""
        exists = labels >= 0
        is_confident = detections.scores_3d >= self.min_score
        gaussians = detected_gaussians(detections)
        updated = update_from_known_lines(
            now=_select(gaussians, is_confident),
            labels=detections.labels_3d[is_confident],
            known=_select(previous, exists),
            known_labels=labels[exists],
            gate_m=self.gate_m,
        )
        # Confident detections get the updated Gaussians. Points of three coordinates keep z.
        means = gaussians.means.index_put((is_confident,), updated.means)
        result = detections.clone()
        result.pts = torch.cat([means, detections.pts[..., 2:]], dim=-1)
        result.scales = gaussians.scales.index_put((is_confident,), updated.scales)
        result.rotations = gaussians.rotations.index_put((is_confident,), updated.rotations)
        return result

    def remember(self, results: Sequence[InstanceData]) -> dict[str, Tensor]:
        """Return the memory of a batch: its confident detections, padded with zeros and label -1.

        Args:
            results: Detections of each sample.

        Returns:
            ``element_labels`` and the Gaussians ``element_means``, ``element_scales`` and
            ``element_rotations``. (B, max_num, ...) each
        """
        padded_by_name: dict[str, list[Tensor]] = {}
        for detections in results:
            is_confident = detections.scores_3d >= self.min_score
            labels = detections.labels_3d[is_confident]
            gaussians = _select(detected_gaussians(detections), is_confident)
            padded = labels.new_full((self.num,), -1)
            padded[: len(labels)] = labels
            padded_by_name.setdefault("labels", []).append(padded)
            for name, values in gaussians._asdict().items():
                padded = values.new_zeros((self.num, *values.shape[1:]))
                padded[: len(values)] = values
                padded_by_name.setdefault(name, []).append(padded)
        return {f"{PREFIX}{name}": torch.stack(values) for name, values in padded_by_name.items()}


def detected_gaussians(detections: InstanceData) -> Gaussians:
    """Gaussians of the detections of a sample, in the plane, float32. (N, P, ...)"""
    return Gaussians(
        means=detections.pts[..., :2].float(),
        scales=detections.scales.float(),
        rotations=detections.rotations.float(),
    )


def _select(gaussians: Gaussians, index: Any) -> Gaussians:
    """Index the first dimension of the fields."""
    return Gaussians(
        means=gaussians.means[index],
        scales=gaussians.scales[index],
        rotations=gaussians.rotations[index],
    )
