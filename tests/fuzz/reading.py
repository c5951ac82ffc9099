"""A reader of files whose file is damaged, and what of its results can be checked."""

import errno
import os
import pickle
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any, ClassVar

import numpy as np
import torch

from fuzz import mutations
from gsmap.datasets.annotations.record import MapSample
from gsmap.structures.elements import MapElements
from gsmap.utils.faults import user_message

_RUNS = ("os.system", "os.exec", "os.posix_spawn", "os.fork", "subprocess.Popen", "pty.spawn")
_CHANGES = {"os.rename": 2, "os.mkdir": 1, "os.remove": 1, "os.rmdir": 1, "os.symlink": 2}
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT


@dataclass
class Reader:
    """One way to read a file.

    Args:
        path: The file that is damaged.
        read: Reads it.
        damages: How its content may be damaged.
        exact: Whether each difference can be noticed, as by a checksum.
    """

    path: Path
    read: Callable[[], Any]
    damages: Sequence[Callable[[bytes, Random], bytes]]
    exact: bool = False
    out: ClassVar[Path]
    """The only folder that a read may write to."""

    def __post_init__(self) -> None:
        self.content = self.path.read_bytes()
        self.right = pickle.dumps(self.read())
        self._reading = False
        self._deeds: list[tuple[str, str]] = []

    def watch(self, event: str, arguments: tuple[Any, ...]) -> None:
        """Refuse and note what a read has no business to do: run a program, or write elsewhere."""
        if not self._reading:
            return
        deed = ("code", str(arguments)) if event in _RUNS else None
        writes = event in _CHANGES or (event == "open" and arguments[2] & _WRITING)
        allowed = os.path.realpath(self.out), f"{tempfile.gettempdir()}/tmp", "/dev/"
        for path in arguments[: _CHANGES.get(event, 1)] if writes else ():
            if isinstance(path, int) or (event != "open" and arguments[-1] >= 0):
                continue  # a file or a folder that is open already
            place = os.path.realpath(os.fsdecode(path))
            if not place.startswith(allowed) and "__pycache__" not in place:
                deed = "outside", place
        if deed is not None:
            self._deeds.append((deed[0], f"{event} {deed[1]}"))
            raise PermissionError(errno.EPERM, *self._deeds[-1])

    def outcome(self, rng: Random) -> tuple[str, str]:
        """Read the file once damaged: what kind of end that took, and the message."""
        mutations.write(self.path, rng.choice(self.damages)(self.content, rng))
        self._deeds.clear()
        end = self._read_damaged()
        return self._deeds[0] if self._deeds else end

    def _read_damaged(self) -> tuple[str, str]:
        self._reading = True
        try:
            result = self.read()
        except Exception as error:
            text = user_message(error)
            if text is None:
                return "traceback", f"{type(error).__name__}: {error}"
            names = self.path.name, str(self.path.parent), "sample '", "record "
            named = any(name in text for name in names)
            return ("clear" if named else "vague"), f"{type(error).__name__}: {text}"
        finally:
            self._reading = False
            mutations.write(self.path, self.content)
        if pickle.dumps(result) == self.right:
            return "right", ""
        wrong = "other content" if self.exact else implausible(result)
        return ("silent", wrong) if wrong else ("other value", "")


@dataclass
class Pictures:
    """A recording's samples, and what is wrong with the images that were made of it."""

    samples: list[MapSample]
    wrong: str


def implausible(result: Any) -> str:
    """Say what of a result cannot be, or nothing."""
    if isinstance(result, Pictures):
        return result.wrong or implausible(result.samples)
    if isinstance(result, (list, tuple)):
        return next(filter(None, map(implausible, result)), "")
    if isinstance(result, dict):
        return implausible(list(result.values()))
    if isinstance(result, torch.Tensor):
        return ""  # weights that are not finite are another matter
    if isinstance(result, np.ndarray) and result.dtype.kind == "f":
        return "" if np.isfinite(result).all() else "not finite"
    if isinstance(result, MapElements):
        arrays = result.points, result.scores, result.scales, result.rotations
        return implausible([array for array in arrays if array is not None])
    return _implausible_sample(result) if isinstance(result, MapSample) else ""


def _implausible_sample(sample: MapSample) -> str:
    poses = [sample.global_from_frame]
    poses += [] if sample.ego_from_frame is None else [sample.ego_from_frame]
    poses += [camera.cam_from_frame for camera in sample.cameras]
    paths = [camera.path for camera in sample.cameras]
    for record in [] if sample.lidar is None else [sample.lidar, *sample.lidar.sweeps]:
        poses.append(record.frame_from_lidar)
        paths.append(record.path)
    for pose in poses:
        rotation = pose[:3, :3]
        if not np.isfinite(pose).all() or np.abs(rotation @ rotation.T - np.eye(3)).max() > 0.01:
            return "a pose is no rigid transform"
        if np.linalg.det(rotation) < 0:
            return "a pose mirrors"
    if any(Path(path).is_absolute() or ".." in Path(path).parts for path in paths):
        return "a path leads out of the data root"
    if not all(isinstance(v, str) for v in (sample.token, sample.scene, sample.map_name, *paths)):
        return "a name is no text"
    for instance in sample.instances or []:
        if not 0 <= instance.label < 3 or not np.isfinite(instance.points).all():
            return "an element is out of its domain"
    calibrations = [camera.intrinsics for camera in sample.cameras]
    return "" if all(np.isfinite(k).all() for k in calibrations) else "calibration not finite"
