"""Transform that packs the results of the data pipeline into the inputs of the model."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from mmcv.transforms import BaseTransform
from mmdet3d.registry import TRANSFORMS
from mmdet3d.structures import Det3DDataSample
from numpy.typing import NDArray

from gsmap.datasets.errors import BrokenSampleError
from gsmap.datasets.transforms.points import check_points_in_frame

# Entries of the results that become metainfo, as far as a pipeline has them.
META_KEYS = (
    "sample_idx", "token", "scene", "map_name", "timestamp_ns", "seconds", "img_path", "cam_names",
    "lidar2img", "cam2img", "lidar2cam", "img_aug_matrix", "img_shape", "ori_shape",
    "lidar2global", "lidar2ego", "can_bus", "x_range", "y_range", "eval_ann_info",
    "image_steps",
)  # fmt: skip
# Entries that become fields of the data sample: the training targets.
TARGET_KEYS = ("gt_instances_3d", "gt_depth", "gt_seg", "gt_pv_seg", "gt_lines", "gt_directions")
# Metainfo that earlier transforms store as a list of one matrix (4, 4) per camera.
_MATRIX_KEYS = ("lidar2img", "cam2img", "lidar2cam", "img_aug_matrix")


@TRANSFORMS.register_module()
@dataclass(eq=False)
class PackMapInputs(BaseTransform):
    """Pack images, points, targets and metainfo for the model (see ``docs/architecture.md``).

    All targets among ``TARGET_KEYS`` that earlier transforms have added are packed. Lists of the
    matrices of V cameras become arrays (V, 4, 4).

    Args:
        with_points: Whether the model receives the loaded points. Set it to False if the points are
            only used for targets.
    """

    with_points: bool = True

    def transform(self, results: dict[str, Any]) -> dict[str, Any]:
        """Pack the sample.

        Args:
            results: Results of the earlier transforms.

        Returns:
            ``inputs``, with ``img`` (V, 3, H, W) and ``points`` (n, C) as far as they are loaded,
            and ``data_samples``, one ``Det3DDataSample`` with targets and metainfo.

        Raises:
            BrokenSampleError: If an image has values that are NaN or infinite.
            ValueError: If the model receives points that are not in the annotation frame.
        """
        inputs = {}
        if "img" in results:
            inputs["img"] = self._images(results)
        if self.with_points and "points" in results:
            check_points_in_frame(results, "PackMapInputs")
            inputs["points"] = results["points"].tensor
        sample = Det3DDataSample()
        for key in TARGET_KEYS:
            if key in results:
                setattr(sample, key, results[key])
        metainfo = {key: results[key] for key in META_KEYS if key in results}
        for key in _MATRIX_KEYS:
            if key in metainfo:
                metainfo[key] = np.stack(metainfo[key])
        sample.set_metainfo(metainfo)
        return {"inputs": inputs, "data_samples": sample}

    def _images(self, results: dict[str, Any]) -> torch.Tensor:
        """Stack images with channels first. V x (H, W, 3) -> (V, 3, H, W)

        Raises:
            BrokenSampleError: If an image has values that are NaN or infinite.
        """
        images = results["img"]
        if results.get("image_steps"):
            # The images are still uint8 as decoded. The data preprocessor applies the recorded
            # steps on the GPU, and makes this strided view contiguous there.
            return torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2)
        height, width = images[0].shape[:2]
        dtype = np.result_type(*[image.dtype for image in images])  # a transform may change some
        stacked = np.empty((len(images), 3, height, width), dtype=dtype)
        for name, img, planes in zip(results["cam_names"], images, stacked, strict=True):
            if img.dtype.kind == "f" and not _is_finite(img):
                raise BrokenSampleError(
                    f"sample {results['token']!r}, camera {name}: the image holds NaN or infinity "
                    f"({results['images'][name]['img_path']}); check the file and the transforms "
                    "before packing."
                )
            planes[:] = cv2.split(img)  # one plane (H, W) per channel
        return torch.from_numpy(stacked)


def _is_finite(image: NDArray[np.floating[Any]]) -> bool:
    """Test whether all values of an image are finite."""
    # The sum is fast to compute. If it is finite, so are all values. If it is not, the sum may have
    # overflowed, so each value is tested.
    return bool(np.isfinite(image.sum()) or np.isfinite(image).all())
