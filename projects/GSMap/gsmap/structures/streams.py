"""Streams of frames, their memory, and rules for the order of frames.

A stream is a sequence of frames of one drive. Its memory is the tensors that a temporal model
computes in a frame and reads in the next one. `Slots` and `Scenes` hold the memory of several
streams. Before each batch, the model reads the memory by ``previous``. After the batch, it stores
the new memory by ``keep``.

A frame is one sample of a drive. The word is also used for coordinate systems, as in "annotation
frame", the coordinate system of the map elements of a sample.
"""

import logging
import operator
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsmap.structures.rigid import invert_rigid, is_rigid
from gsmap.utils.errors import InputError, InputTypeError

_LOGGER = logging.getLogger(__name__)
_MANY_GAPS = 20  # so many frames after a gap, and none without one, are named
# Placeholders: number of frames, seconds of the latest gap, and of the longest allowed one.
_NO_MEMORY = (
    "the model has no memory of earlier frames: none of %d frames continued a stream. The last one "
    "came %.3f s after the frame before, and streams go on after more than 0 and up to %g s "
    "(temporal.max_gap_s). Give samples their times (timestamp_ns, in nanoseconds) and scenes, or "
    "set a longer gap."
)


@dataclass(frozen=True)
class Frame:
    """Sample of a stream.

    Args:
        token: Name of the sample.
        scene: Name of the scene, which is a drive or a part of it.
        timestamp_ns: Time in nanoseconds.
        pose: Transform from the annotation frame to the world in metres. (4, 4)

    Raises:
        TypeError: If the time is no integer.
        ValueError: If the pose is no finite rigid motion (4, 4).
    """

    token: str
    scene: str
    timestamp_ns: int
    pose: NDArray[np.float64]

    def __post_init__(self) -> None:
        try:
            # Any integer becomes an `int`, because differences of unsigned ones are never negative.
            timestamp_ns = operator.index(self.timestamp_ns)
        except TypeError as error:
            raise InputTypeError(
                f"timestamp_ns of sample {self.token!r} must be an integer of nanoseconds, got "
                f"{self.timestamp_ns!r}."
            ) from error
        object.__setattr__(self, "timestamp_ns", timestamp_ns)  # the class is frozen
        pose = np.asarray(self.pose)
        if pose.shape != (4, 4) or not is_rigid(pose):
            raise InputError(
                f"lidar2global of sample {self.token!r} must be a finite rigid motion (4, 4) from "
                "its annotation frame to the world, a rotation with 0, 0, 0, 1 below: got "
                f"{pose.tolist()!r:.200}."
            )

    @classmethod
    def from_meta(cls, meta: Mapping[str, Any]) -> "Frame":
        """Create a frame from the metainfo of a sample.

        Args:
            meta: Metainfo with ``scene``, ``timestamp_ns``, ``token``, and the pose as
                ``lidar2global``. Only the token may be missing.

        Raises:
            TypeError: If the time is no integer.
            ValueError: If a field is missing or the pose is no rigid motion.
        """
        fields = ("scene", "timestamp_ns", "lidar2global")
        missing = [name for name in fields if meta.get(name) is None]
        if missing:
            raise InputError(
                f"sample {meta.get('token')!r} has no {missing} in its metainfo, which a model "
                "with memory needs: give each sample its scene, time and pose."
            )
        return cls(
            token=str(meta.get("token")),
            scene=str(meta["scene"]),
            timestamp_ns=meta["timestamp_ns"],
            pose=np.asarray(meta["lidar2global"], np.float64),
        )

    def __str__(self) -> str:
        return f"{self.token!r} (scene {self.scene!r}, {self.timestamp_ns / 1e9:.3f} s)"

    def seconds_after(self, earlier: "Frame") -> float:
        """Time since another frame in seconds; negative if that frame is later."""
        return (self.timestamp_ns - earlier.timestamp_ns) / 1e9

    def motion_from(self, earlier: "Frame") -> NDArray[np.float64]:
        """Transform in metres from the annotation frame of another sample to this one's. (4, 4)"""
        return invert_rigid(self.pose) @ earlier.pose


@dataclass(frozen=True)
class StreamState:
    """Memory of one stream after a frame.

    Args:
        frame: Last frame of the stream.
        values: Memory after the frame, by name: tensors without gradient, or arrays.
    """

    frame: Frame
    values: Mapping[str, Any] = field(default_factory=dict)


class _Gaps:
    """Rule by which a frame continues the stream of its scene.

    A warning is logged if many frames come after a gap, and none continues a stream.

    Args:
        max_gap_s: Longest time between two frames of a stream in seconds.
    """

    def __init__(self, max_gap_s: float) -> None:
        self.max_gap_s = max_gap_s
        self._num_gaps = 0
        self._has_continued = False

    def _continues(self, seconds: float) -> bool:
        """Whether a frame continues the stream of its scene. It is called once for each frame.

        Args:
            seconds: Time since the last frame of the scene.
        """
        if 0 < seconds <= self.max_gap_s:
            self._has_continued = True
            return True
        self._num_gaps += 1
        if self._num_gaps == _MANY_GAPS and not self._has_continued:
            _LOGGER.warning(_NO_MEMORY, self._num_gaps, seconds, self.max_gap_s)
        return False


class Slots(_Gaps):
    """Streams by their index in the batch, for training.

    A sampler supplies each index with consecutive samples. A sample that does not follow the
    previous one (another scene, an equal or earlier time, a gap) starts a new stream. Unlike in
    `Scenes`, this is no error, because training jumps between scenes.

    Args:
        max_gap_s: Longest time between two samples of a stream in seconds.
    """

    def __init__(self, max_gap_s: float) -> None:
        super().__init__(max_gap_s)
        self.states: list[StreamState] = []

    def previous(self, frames: Sequence[Frame]) -> list[StreamState | None]:
        """Look up the states that frames continue.

        Args:
            frames: Frames of a batch.

        Returns:
            State of the stream of each frame; None for a frame that starts a stream.
        """
        states: list[StreamState | None] = []
        for index, frame in enumerate(frames):
            state = self.states[index] if index < len(self.states) else None
            if state is not None and not self._follows(frame, state):
                state = None
            states.append(state)
        return states

    def _follows(self, frame: Frame, state: StreamState) -> bool:
        """Whether a frame continues the stream of a state."""
        if frame.scene != state.frame.scene:
            return False
        return self._continues(frame.seconds_after(state.frame))

    def keep(self, states: Sequence[StreamState]) -> None:
        """Store the states after the frames of a batch, in the order of the batch."""
        self.states = list(states)


class Scenes(_Gaps):
    """Streams by the name of their scene, for testing. Frames of a scene must come in order.

    The streams are bound to one model (`claim`), since another model cannot read its memory. A
    copy, for example by pickle, does not contain the model. It can be continued by any model of
    equal name (``str(model)``).

    Args:
        max_gap_s: Longest time between two frames of a stream in seconds.
        max_streams: Largest number of streams. Beyond it, the stream that has received no frame for
            the longest time is dropped.

    Attributes:
        states: State of each stream by the name of its scene, the stream with the latest frame
            last.
        owner: Model that the streams are bound to, the name of the model in a copy, or None.
    """

    def __init__(self, max_gap_s: float, max_streams: int = 16) -> None:
        super().__init__(max_gap_s)
        self.max_streams = max_streams
        self.states: OrderedDict[str, StreamState] = OrderedDict()
        self.owner: object = None

    def claim(self, owner: object) -> None:
        """Bind the streams to a model.

        Args:
            owner: Model.

        Raises:
            ValueError: If the streams are bound to another model, or are a copy for a model of
                another name.
        """
        # In a copy, `self.owner` is the name of the model (`__getstate__`). The first model of this
        # name becomes the owner.
        if self.owner is None or self.owner == str(owner):
            self.owner = owner
        if self.owner is not owner:
            raise InputError(
                f"this stream belongs to {self.owner}, and {owner} cannot read its memory: "
                "start a new stream for each model (new_stream)."
            )

    def __getstate__(self) -> dict[str, Any]:
        """Attributes of a copy, with the name of the model instead of the model."""
        attributes = dict(vars(self))
        if self.owner is not None:
            attributes["owner"] = str(self.owner)
        return attributes

    def previous(self, frames: Sequence[Frame]) -> list[StreamState | None]:
        """Look up the states that frames continue.

        Args:
            frames: Frames of a batch.

        Returns:
            State of the stream of each frame; None for a frame that starts a stream, which is the
            first one of its scene or follows a gap.

        Raises:
            ValueError: If two frames are of one scene, or a frame is not later than the previous
                frame of its scene.
        """
        states: list[StreamState | None] = []
        frame_of_scene: dict[str, Frame] = {}
        for frame in frames:
            if frame.scene in frame_of_scene:
                raise InputError(
                    f"frames {frame_of_scene[frame.scene]} and {frame} of one scene are in one "
                    "batch, but the later one needs the memory of the earlier one: set "
                    "batch_size=1 or use StreamBatches."
                )
            frame_of_scene[frame.scene] = frame
            states.append(self._previous_state(frame))
        return states

    def _previous_state(self, frame: Frame) -> StreamState | None:
        """Look up the state that a frame continues; raise ValueError if the frame is not later."""
        state = self.states.get(frame.scene)
        if state is None:
            return None
        seconds = frame.seconds_after(state.frame)
        if seconds <= 0:
            fault = "comes twice" if seconds == 0 else "comes too late"
            raise InputError(
                f"frame {frame} {fault}: its stream is at {state.frame} already. Hand a stream its "
                "frames once each and in order, or start a new stream."
            )
        return state if self._continues(seconds) else None

    def keep(self, states: Sequence[StreamState]) -> None:
        """Store the states after the frames of a batch."""
        for state in states:
            self.states[state.frame.scene] = state
            self.states.move_to_end(state.frame.scene)  # so the oldest stream is at the beginning
        # Streams of this batch are never dropped, even if the batch is larger than the limit.
        while len(self.states) > max(self.max_streams, len(states)):
            self.states.popitem(last=False)


class MapStream(Scenes):
    """Stream of a single scene for `MapInferencer`, which predicts maps frame by frame.

    Args:
        max_gap_s: Longest time between two frames of the stream in seconds.
    """

    def __init__(self, max_gap_s: float = 2.0) -> None:
        super().__init__(max_gap_s, max_streams=1)

    @property
    def last(self) -> Frame | None:
        """Last frame of the stream, or None before the first one."""
        states = list(self.states.values())  # at most one
        return states[0].frame if states else None

    def previous(self, frames: Sequence[Frame]) -> list[StreamState | None]:
        """Look up the states that frames continue.

        Args:
            frames: Frames of a batch.

        Returns:
            State of the stream of each frame; None for a frame that starts the stream.

        Raises:
            ValueError: If a frame is of another scene, or is not later than the previous frame, or
                there is more than one frame.
        """
        last = self.last
        for frame in frames:
            if last is None:  # the first frame determines the scene
                last = frame
            if frame.scene != last.scene:
                raise InputError(
                    f"frame {frame} belongs to another scene than {last}, where the stream is: "
                    "start a new stream for each scene."
                )
        return super().previous(frames)
