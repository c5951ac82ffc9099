"""How recordings of any kind are read."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path


@dataclass(frozen=True)
class InputOptions:
    """How inputs are read; each kind reads what concerns it.

    Args:
        data_root: Folder that paths of an annotation or info file start from.
        allow_missing_cameras: Whether an info file may name images that do not exist.
        version: Version folder of a nuScenes-format root; the only one by default.
        rate_hz: Samples per second of Argoverse 2 logs and bags; None takes all.
        frames_dir: Folder for images that have to be made, a bag's and those of distorted cameras,
            in a folder for each input.
        vehicle_frame: The vehicle's frame (x ahead, y left, z up) in a bag's transforms;
            ``base_footprint`` or ``base_link`` by default.
        vehicle_ground_z_m: Height of the road in that frame; None is 0.
        topics: Topics of images and camera info of a bag, by camera (``parse_topics``).
        trained: By camera, what a model was trained on (``load_model(...).rig``): images of
            distorted cameras of these names are rectified to those focal lengths.
        calibration: Calibration file of a bag's cameras, in place of their infos and transforms;
            their names are those of the topics, or its ``images`` are topics.
    """

    data_root: Path | None = None
    allow_missing_cameras: bool = False
    version: str | None = None
    rate_hz: float | None = 2.0
    frames_dir: Path = Path("frames")
    vehicle_frame: str | None = None
    vehicle_ground_z_m: float | None = None
    topics: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    calibration: Path | None = None
    trained: Mapping[str, Sequence[float]] = field(default_factory=dict)
