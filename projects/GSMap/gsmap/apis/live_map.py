"""A trained model on the cameras of one vehicle, whose images come frame by frame."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gsmap.datasets.memory import Cameras, bgr_by_name, sample_of_rig
from gsmap.datasets.source import Source
from gsmap.structures.elements import MapElements

if TYPE_CHECKING:
    from mmdet3d.structures import Det3DDataSample

    from gsmap.apis.map_inferencer import MapInferencer
    from gsmap.datasets.vectorized_map_dataset import VectorizedMapDataset


class LiveMap:
    """The map around a vehicle, frame by frame, from images in memory.

    The calibration is fitted to the model once. The models of this project see each frame by
    itself, so that nothing is kept from one to the next. Arguments are those of
    ``MapInferencer.predict_images``; ``MapInferencer.live`` makes it.
    """

    def __init__(
        self,
        inferencer: "MapInferencer",
        intrinsics: Cameras,
        cam_from_frame: Cameras,
        frame: str | None = None,
        allow_missing_cameras: bool = False,
    ):
        self._inferencer = inferencer
        self._config = inferencer.cfg.test_dataloader.dataset
        self._rig = intrinsics, cam_from_frame
        self._frame = frame or self._config.get("frame") or "lidar"
        self._allow_missing_cameras = allow_missing_cameras
        self._sizes: dict[str, tuple[int, ...]] = {}
        self._dataset: VectorizedMapDataset

    def __call__(self, images: Cameras) -> MapElements:
        """Return the map elements in one frame's images; errors as in `predict`."""
        return self._inferencer.elements(self.predict(images))

    def predict(self, images: Cameras) -> "Det3DDataSample":
        """Run the model on one frame.

        Args:
            images: RGB, uint8, as the calibration names or lists the cameras. each (H, W, 3)

        Returns:
            The sample, with ``pred_instances_3d`` on the CPU in the frame of the config.

        Raises:
            TypeError: If an image is not uint8.
            ValueError: As in ``MapInferencer.predict_images``.
        """
        pixels = bgr_by_name(images)
        sizes = {name: image.shape for name, image in pixels.items()}
        if sizes != self._sizes:
            self._dataset, self._sizes = self._open(pixels), sizes
        self._dataset.images_in_memory = pixels
        allowed = self._allow_missing_cameras
        (found,) = self._inferencer.predict(self._dataset, allow_missing_cameras=allowed)
        return found

    def _open(self, pixels: dict[str, np.ndarray]) -> "VectorizedMapDataset":
        """Check the calibration, and return the data set of one sample that has it."""
        sample = sample_of_rig(pixels, *self._rig, self._frame)
        foreign = set(pixels) - set(self._config.get("cameras") or pixels)
        if foreign and foreign != set(pixels):
            raise ValueError(
                f"the model has the cameras {list(self._config.cameras)}, but not "
                f"{sorted(foreign)}: name all cameras as it does, or none."
            )
        dataset = self._inferencer.dataset(Source([sample], self._frame, None, has_poses=False))
        Path(dataset.ann_file).unlink()  # it is read, and a rig may be opened often
        return dataset
