"""Options of the readers of recordings and of other inputs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path


@dataclass(frozen=True)
class InputOptions:
    """Options of the readers of inputs. Each reader ignores options for other kinds of inputs.

    Args:
        data_root: Folder that paths of an annotation or info file are relative to.
        allow_missing_cameras: Whether an info file may name images that do not exist.
        version: Name of the version folder in a nuScenes-format root, such as ``v1.0-mini``; None
            takes the only one.
        rate_hz: Samples per second of Argoverse 2 logs and bags; None takes all.
        frames_dir: Folder for images that have to be written: images of bags, and rectified images
            of distorted cameras. Each input gets a folder in it.
        vehicle_frame: Name of the vehicle's frame (x ahead, y left, z up) in a bag's transforms;
            None takes ``base_footprint`` or ``base_link``.
        vehicle_ground_z_m: Height of the road in the vehicle's frame in metres; None takes
            ``ground_z_m`` of ``calibration``, or else 0.
        topics: Topic of the images and topic of the camera info (empty if not given) of a bag, by
            the name of the camera. ``parse_topics`` reads them from the command line.
        calibration: Calibration file of a bag's cameras, in place of their camera info and
            transforms. The topic of a camera is the one in ``topics``, its entry ``images`` in the
            file, or its name.
        trained: Width, height, fx, fy, cx and cy of the cameras that a model was trained on, by
            name (``load_model(...).rig``). An image of a distorted camera with one of these names
            is rectified to the size and the intrinsics under this name.
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
