"""Memory of a detector: values of previous frames are recalled, and new ones are stored.

A batch has the current frame of each of B streams, sequences of frames of one drive.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from mmengine.model import BaseModule
from mmengine.structures import InstanceData
from torch import Tensor

from gsmap.models.base.head import MapHead
from gsmap.models.base.hooks import FlowHook
from gsmap.models.base.parts import build_part
from gsmap.models.streams.bev_memory import BEVMemory
from gsmap.models.streams.element_memory import PREFIX, ElementMemory
from gsmap.models.streams.query_memory import Propagation, QueryMemory
from gsmap.structures.past import Past
from gsmap.structures.streams import Frame, MapStream, Scenes, Slots, StreamState
from gsmap.structures.tensors import upload
from gsmap.utils.errors import InputError

# Values whose name has one of these prefixes are stored in single precision. They are coordinates,
# for which half precision has errors of centimetres. The names of `ElementMemory` begin with
# `PREFIX`.
_SINGLE_PRECISION_PREFIXES = ("references", "targets", PREFIX)


@dataclass
class BatchMemory:
    """Encoder outputs of a batch, the memory recalled for them, and the detections to store.

    Hooks are objects whose methods the head calls between its steps (`FlowHook`).

    Args:
        outputs: Outputs of the encoder. Their ``bev_feats`` (B, C, H, W) are fused with the memory.
        past: Memory of the previous frames and the ego motion since then. None if no memory is
            used: the model has none, or its only memory is of elements and it trains. A first frame
            has a `Past`, too.
        propagation: Hook that adds the memory of queries to the head, or None.
        elements: Detections to store for the next frame, by name. (B, ...) each
        further_hooks: Hooks that are called before ``propagation``, such as the hook of a map
            prior.
    """

    outputs: dict[str, Any]
    past: Past | None = None
    propagation: Propagation | None = None
    elements: dict[str, Tensor] = field(default_factory=dict)
    further_hooks: tuple[FlowHook, ...] = ()

    @property
    def hooks(self) -> dict[str, tuple[FlowHook, ...]]:
        """Keyword arguments of the head: ``hooks``, or an empty dictionary without hooks."""
        hooks = self.further_hooks
        if self.propagation is not None:
            hooks = (*hooks, self.propagation)
        return {"hooks": hooks} if hooks else {}


class StreamMemory(BaseModule):
    """Memory of a `MapDetector`, with one state for each stream, a sequence of frames.

    A state has the latest frame of the stream and the values that were stored for it. States are
    transformed to the current frame by the poses of the samples. In training, a stream consists of
    the samples at one index of the batch (`Slots`). In testing, it is a scene (`Scenes`), and every
    scene starts with an empty memory. The metainfo of a sample needs ``scene``, ``timestamp_ns``
    and ``lidar2global``.

    Args:
        head: Head of the detector. It must be a `MapHead` if ``queries`` is given.
        bev: Settings of `BEVMemory`, or None for no memory of BEV features.
        queries: Settings of `QueryMemory`, or None for no memory of queries.
        elements: Settings of `ElementMemory`, or None for no memory of elements.
        embed_dims: Channels of the BEV features.
        max_gap_s: Longest pause between two frames of a stream, in seconds. After a longer pause
            the stream restarts.
        half: Store features in half precision; coordinates keep single precision.

    Attributes:
        name: Description of the model for error messages, such as "a model with MapHead".

    Raises:
        ValueError: If ``bev``, ``queries`` and ``elements`` are all None, if one of them does not
            fit the head, or if ``max_gap_s`` is not > 0.
    """

    def __init__(
        self,
        head: Any,
        bev: dict[str, Any] | None = None,
        queries: dict[str, Any] | None = None,
        elements: dict[str, Any] | None = None,
        embed_dims: int = 256,
        max_gap_s: float = 2.0,
        half: bool = False,
    ) -> None:
        super().__init__()
        if bev is None and queries is None and elements is None:
            raise InputError(
                "temporal needs at least one of bev, queries and elements, such as bev=dict(...)."
            )
        if not max_gap_s > 0:
            raise InputError(f"temporal.max_gap_s must be seconds > 0, got {max_gap_s}.")
        self.max_gap_s = max_gap_s
        self.half = half
        self.name = f"a model with {type(head).__name__}"
        self.bev: BEVMemory | None = None
        if bev is not None:
            # The keywords are defaults of settings that ``bev`` does not contain.
            self.bev = build_part(bev, type="BEVMemory", grid=head.grid, embed_dims=embed_dims)
        self.queries: QueryMemory | None = None
        if queries is not None:
            if not isinstance(head, MapHead):
                raise InputError(
                    f"{type(head).__name__} can have no memory of queries, which needs a MapHead: "
                    "set temporal.queries=None; temporal.bev works with every head."
                )
            self.queries = build_part(queries, type="QueryMemory", embed_dims=head.embed_dims)
            self.queries.check(head)  # raises an error if the head has too few layers or queries
        self.elements: ElementMemory | None = None
        if elements is not None:
            self.elements = build_part(elements, type="ElementMemory", head=head)
        self.streams: Slots | Scenes = Slots(max_gap_s)

    def __str__(self) -> str:
        # A stream is bound to its model (`Scenes.claim`). A copy of it, for example by pickle,
        # contains this name instead of the model. A model of this name can continue the copy.
        return self.name

    def train(self, mode: bool = True) -> "StreamMemory":
        """Set the mode, and clear the memory of all streams. The method `eval` calls it, too."""
        self.streams = Slots(self.max_gap_s) if mode else self.new_scenes()
        return super().train(mode)

    def new_scenes(self) -> Scenes:
        """Create an empty memory of scenes."""
        return Scenes(self.max_gap_s)

    def new_stream(self) -> MapStream:
        """Create an empty memory of one scene for the caller, bound to this model."""
        stream = MapStream(self.max_gap_s)
        stream.claim(self)  # `using` of another model then raises an error
        return stream

    @contextmanager
    def using(self, stream: Scenes) -> Iterator[None]:
        """Context manager that uses a memory of the caller instead of the model's memory.

        Args:
            stream: Memory that `new_stream` or `new_scenes` has created.

        Raises:
            ValueError: If the stream belongs to another model.
        """
        # Raises the error above. A stream that belongs to no model is bound to this one.
        stream.claim(self)
        model_streams = self.streams
        self.streams = stream
        try:
            yield
        finally:
            self.streams = model_streams

    @contextmanager
    def remember_batch(
        self, outputs: dict[str, Any], metas: Sequence[Mapping[str, Any]]
    ) -> Iterator[BatchMemory]:
        """Context manager that recalls the memory of a batch, and stores its new memory at the end.

        Nothing is stored if the context ends with an error.

        Args:
            outputs: Outputs of the encoder, with ``bev_feats`` (B, C, H, W).
            metas: Metainfo of each sample.

        Yields:
            The batch with its memory.
        """
        has_trained_memory = self.bev is not None or self.queries is not None
        if self.training and not has_trained_memory:
            # The memory of elements is not used in training, so the samples need no poses.
            yield BatchMemory(outputs)
            return
        frames = [Frame.from_meta(meta) for meta in metas]
        # The state that each frame continues, or None where a stream starts.
        states = self.streams.previous(frames)
        past = stack_past(frames, states=states, device=outputs["bev_feats"].device)
        batch = self.recall(outputs, past)
        yield batch
        memory = self.collect_memory(batch)
        new_states = []
        for index, frame in enumerate(frames):
            values = {name: stacked[index] for name, stacked in memory.items()}
            new_states.append(StreamState(frame, values))
        self.streams.keep(new_states)

    def recall(self, outputs: dict[str, Any], past: Past) -> BatchMemory:
        """Fuse the outputs of the encoder with the memory.

        Args:
            outputs: Outputs of the encoder, with ``bev_feats`` (B, C, H, W).
            past: Memory of the previous frames and the ego motion since then.

        Returns:
            The batch with fused ``bev_feats``.
        """
        feats = outputs["bev_feats"]
        # The fusion keeps the shape of the features and computes in float32.
        if self.bev is not None:
            with torch.autocast(feats.device.type, enabled=False):
                feats = self.bev(feats.float(), past)
        propagation = None if self.queries is None else Propagation(self.queries, past)
        return BatchMemory(
            outputs={**outputs, "bev_feats": feats}, past=past, propagation=propagation
        )

    def update_detections(
        self, batch: BatchMemory, results: Sequence[InstanceData]
    ) -> Sequence[InstanceData]:
        """Update the detections of a batch by the memory of elements, and remember the result.

        Args:
            batch: Batch with its memory. Its ``elements`` are set to the memory of the result.
            results: Detections of each sample.

        Returns:
            Updated detections of each sample; ``results`` without a memory of elements, or if
            ``batch.past`` is None.
        """
        if self.elements is None or batch.past is None:
            return results
        results = self.elements.update_detections(results, batch.past)
        batch.elements = self.elements.remember(results)
        return results

    def collect_memory(self, batch: BatchMemory) -> dict[str, Tensor]:
        """Collect the memory to store for the next frame, by name, without gradient. (B, ...) each

        Args:
            batch: Batch after the head has run.
        """
        memory = dict(batch.elements)
        if self.bev is not None:
            memory["bev_feats"] = self.bev.remember(batch.outputs["bev_feats"])
        if batch.propagation is not None:
            memory |= batch.propagation.collect_memory()
        if self.half:
            for name, values in memory.items():
                is_coordinate = name.startswith(_SINGLE_PRECISION_PREFIXES)
                if not is_coordinate:
                    memory[name] = values.half()
        return memory


def stack_past(
    frames: Sequence[Frame], states: Sequence[StreamState | None], device: torch.device
) -> Past:
    """Stack the stream states of a batch.

    The memory of a stream that starts is zeros. If all streams start, the memory has no tensors,
    because their names and shapes are not known.

    Args:
        frames: The frames of the batch.
        states: State of the stream of each frame, or None where a stream starts.
        device: Device of the result.

    Returns:
        Memory, ego motion and elapsed time of each frame. For a stream that starts, the motion is
        the identity and the time is 0.
    """
    motions = []
    seconds = []
    for frame, state in zip(frames, states, strict=True):
        if state is None:
            motions.append(np.eye(4))
            seconds.append(0.0)
        else:
            motions.append(frame.motion_from(state.frame))
            seconds.append(frame.seconds_after(state.frame))
    # All three are copied to the device at once: (B, 4, 4), (B,) and (B,).
    now_from_then, elapsed, continues = upload(
        [
            torch.from_numpy(np.stack(motions)),
            torch.tensor(seconds, dtype=torch.float64),
            torch.tensor([state is not None for state in states]),
        ],
        device,
    )
    # All states have values of equal names and shapes, so any one serves as an example for the
    # zeros. If all streams start, there is no example, and the memory stays empty.
    examples = next((state.values for state in states if state is not None), {})
    memory = {}
    for name, example in examples.items():
        values = []  # of each frame of the batch
        for state in states:
            values.append(torch.zeros_like(example) if state is None else state.values[name])
        memory[name] = torch.stack(values).to(device)
    return Past(memory, now_from_then=now_from_then, seconds=elapsed, continues=continues)
