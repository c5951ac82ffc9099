"""What is kept of a stream of frames, and which frame may follow which."""

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsmap.structures.rigid import invert_rigid, is_rigid
from gsmap.utils.errors import InputError


@dataclass(frozen=True)
class Frame:
    """A sample as its stream knows it.

    Args:
        token: Its name.
        scene: Name of its scene.
        timestamp_ns: Its time in nanoseconds.
        pose: From the annotation frame to the world. (4, 4)

    Raises:
        ValueError: If the pose is no rigid motion.
    """

    token: str
    scene: str
    timestamp_ns: int
    pose: NDArray[np.float64]

    def __post_init__(self) -> None:
        pose = np.asarray(self.pose)
        if pose.shape != (4, 4) or not is_rigid(pose):
            raise InputError(
                f"lidar2global of sample {self.token!r} must be a finite rigid motion (4, 4) from "
                "its annotation frame to the world, a rotation with 0, 0, 0, 1 below: got "
                f"{pose.tolist()!r:.200}."
            )

    @classmethod
    def of(cls, meta: Mapping[str, Any]) -> "Frame":
        """Read a sample's metainfo; ValueError if a field is missing, or the pose is none."""
        missing = [k for k in ("scene", "timestamp_ns", "lidar2global") if meta.get(k) is None]
        if missing:
            raise InputError(
                f"sample {meta.get('token')!r} has no {missing} in its metainfo, which a model "
                "with memory needs: give each sample its scene, time and pose."
            )
        pose = np.asarray(meta["lidar2global"], np.float64)
        return cls(str(meta.get("token")), str(meta["scene"]), int(meta["timestamp_ns"]), pose)

    def __str__(self) -> str:
        return f"{self.token!r} (scene {self.scene!r}, {self.timestamp_ns / 1e9:.3f} s)"

    def seconds_after(self, earlier: "Frame") -> float:
        """Return the time since another frame."""
        return (self.timestamp_ns - earlier.timestamp_ns) / 1e9

    def motion_from(self, earlier: "Frame") -> NDArray[np.float64]:
        """Return what takes metres of another frame to metres of this one. (4, 4)"""
        return invert_rigid(self.pose) @ earlier.pose


@dataclass(frozen=True)
class StreamState:
    """The memory of one stream after a frame.

    Args:
        frame: The frame.
        values: What it leaves, by name: tensors without gradient, or arrays.
    """

    frame: Frame
    values: Mapping[str, Any] = field(default_factory=dict)


class Slots:
    """Streams by their place in the batch, for training.

    A sampler hands each place consecutive samples. Where a sample does not follow the one before
    (another scene, back in time, a gap), the place starts anew.
    """

    def __init__(self, max_gap_s: float) -> None:
        self.max_gap_s = max_gap_s
        self.states: list[StreamState] = []

    def previous(self, frames: Sequence[Frame]) -> list[StreamState | None]:
        """Return the state that each frame continues, or None."""
        found: list[StreamState | None] = []
        for index, frame in enumerate(frames):
            state = self.states[index] if index < len(self.states) else None
            follows = state is not None and state.frame.scene == frame.scene
            if state is None or not follows:
                found.append(None)
                continue
            seconds = frame.seconds_after(state.frame)
            found.append(state if 0 < seconds <= self.max_gap_s else None)
        return found

    def keep(self, states: Sequence[StreamState]) -> None:
        """Keep what the frames leave."""
        self.states = list(states)


class Scenes:
    """Streams by the name of their scene, for testing; frames of a scene must come in order.

    A copy, or what is pickled, goes on from where it was, with a model of the same name.

    Args:
        max_gap_s: A longer pause, in seconds, starts a stream anew.
        max_streams: Streams that are kept; the one that has waited longest goes first.
    """

    def __init__(self, max_gap_s: float, max_streams: int = 16) -> None:
        self.max_gap_s, self.max_streams = max_gap_s, max_streams
        self.states: OrderedDict[str, StreamState] = OrderedDict()
        self.owner: object = None

    def claim(self, owner: object) -> None:
        """Belong to a model from its first frame on; ValueError, with both names, for another."""
        if self.owner is None or self.owner == str(owner):  # a copy has the name alone
            self.owner = owner
        if self.owner is not owner:
            raise InputError(
                f"this stream is of {self.owner}, and {owner} cannot read what that remembers: "
                "start a new stream for each model (new_stream)."
            )

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy has: of the model its name, not the weights."""
        return {**vars(self), "owner": None if self.owner is None else str(self.owner)}

    def previous(self, frames: Sequence[Frame]) -> list[StreamState | None]:
        """Return the state that each frame continues, or None.

        Raises:
            ValueError: If a frame is not later than the one before it in its scene.
        """
        found: list[StreamState | None] = []
        batch: dict[str, Frame] = {}
        for frame in frames:
            if frame.scene in batch:
                raise InputError(
                    f"frames {batch[frame.scene]} and {frame} of one scene are in one batch: one "
                    "needs what the other leaves; set batch_size=1 or use StreamBatches."
                )
            batch[frame.scene] = frame
            found.append(self._followed(frame))
        return found

    def _followed(self, frame: Frame) -> StreamState | None:
        state = self.states.get(frame.scene)
        if state is None:
            return None
        seconds = frame.seconds_after(state.frame)
        if seconds <= 0:
            what = "comes twice" if seconds == 0 else "comes too late"
            raise InputError(
                f"frame {frame} {what}: its stream is at {state.frame} already. Hand a stream its "
                "frames once each and in order, or start a new stream."
            )
        return state if seconds <= self.max_gap_s else None

    def keep(self, states: Sequence[StreamState]) -> None:
        """Keep what the frames leave."""
        for state in states:
            self.states[state.frame.scene] = state
            self.states.move_to_end(state.frame.scene)
        while len(self.states) > max(self.max_streams, len(states)):
            self.states.popitem(last=False)


class MapStream(Scenes):
    """One stream of a caller's own, of a single scene, with `MapInferencer`.

    A frame of another scene, one that comes twice or too late is an error that names both frames.
    """

    def __init__(self, max_gap_s: float = 2.0) -> None:
        super().__init__(max_gap_s, max_streams=1)

    @property
    def last(self) -> Frame | None:
        """The frame that the stream has reached."""
        return next((state.frame for state in self.states.values()), None)

    def previous(self, frames: Sequence[Frame]) -> list[StreamState | None]:
        """Return the state that each frame continues; ValueError also for another scene."""
        reached = self.last or next(iter(frames), None)
        for frame in frames:
            if reached is not None and frame.scene != reached.scene:
                raise InputError(
                    f"frame {frame} is of another scene than {reached}, where the stream is: "
                    "start a new stream for each scene."
                )
        return super().previous(frames)
