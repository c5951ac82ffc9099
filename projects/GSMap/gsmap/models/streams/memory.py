"""A detector's memory: what its streams have left enters a batch, and what the batch leaves."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from mmdet3d.registry import MODELS
from mmengine.model import BaseModule
from mmengine.structures import InstanceData
from torch import Tensor

from gsmap.models.base.head import MapHead
from gsmap.models.base.hooks import FlowHook
from gsmap.models.streams.bev_memory import BEVMemory
from gsmap.models.streams.element_memory import PREFIX, ElementMemory
from gsmap.models.streams.query_memory import Propagation, QueryMemory
from gsmap.structures.past import Past
from gsmap.structures.streams import Frame, MapStream, Scenes, Slots, StreamState
from gsmap.structures.tensors import uploaded
from gsmap.utils.errors import InputError

# beginnings of names: half precision would move a point by centimetres
_EXACT = ("references", "targets", PREFIX)


@dataclass
class Remembering:
    """A batch of a detector with memory, from its encoder to what it leaves.

    Args:
        outputs: What the encoder returns, ``bev_feats`` of all frames so far. (B, C, H, W)
        past: What the streams have left, None without memory.
        propagation: The memory of queries, None without.
        elements_left: What the detections leave, by name. (B, ...) each
    """

    outputs: dict[str, Any]
    past: Past | None = None
    propagation: Propagation | None = None
    elements_left: dict[str, Tensor] = field(default_factory=dict)

    @property
    def hooks(self) -> dict[str, tuple[FlowHook, ...]]:
        """The argument ``hooks`` of a head, none for a head without memory of queries."""
        return {} if self.propagation is None else {"hooks": (self.propagation,)}


class StreamMemory(BaseModule):
    """The memory of a `MapDetector`, one state per stream, moved by the poses of the samples.

    In training a stream is a place in the batch (`Slots`), in testing a scene (`Scenes`), whose
    memories are empty at the start of each. Samples have ``scene``, ``timestamp_ns`` and
    ``lidar2global`` in their metainfo.

    Args:
        head: The detector's head, for queries a `MapHead`.
        bev: Settings of `BEVMemory`, or None without memory of the map's features.
        queries: Settings of `QueryMemory`, or None without memory of queries.
        elements: Settings of `ElementMemory`, or None without memory of elements.
        embed_dims: Channels of the map's features.
        max_gap_s: A longer pause between two frames, in seconds, starts a stream anew.
        half: Keep what is no place in half precision.

    Attributes:
        name: The model's, for errors.

    Raises:
        ValueError: If there is no memory, one does not fit the head, or the pause is not > 0.
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
                "temporal needs bev=dict(...), queries=dict(...), elements=dict(...) or several."
            )
        if not max_gap_s > 0:
            raise InputError(f"temporal.max_gap_s must be seconds > 0, got {max_gap_s}.")
        self.max_gap_s, self.half = max_gap_s, half
        self.name = f"a model with {type(head).__name__}"
        self.bev: BEVMemory | None = None
        if bev is not None:
            part = {"type": "BEVMemory", "grid": head.grid, "embed_dims": embed_dims}
            self.bev = MODELS.build({**part, **bev})
        self.queries: QueryMemory | None = None
        if queries is not None:
            if not isinstance(head, MapHead):
                raise InputError(
                    f"{type(head).__name__} can have no memory of queries, which needs a MapHead: "
                    "set temporal.queries=None; temporal.bev works with every head."
                )
            part = {"type": "QueryMemory", "embed_dims": head.embed_dims}
            self.queries = MODELS.build({**part, **queries})
            self.queries.check(head)
        self.elements: ElementMemory | None = None
        if elements is not None:
            self.elements = MODELS.build({"type": "ElementMemory", "head": head, **elements})
        self.streams: Slots | Scenes = Slots(max_gap_s)

    def __str__(self) -> str:
        return self.name

    def train(self, mode: bool = True) -> "StreamMemory":
        """Switch between training and testing, and forget all streams."""
        self.streams = Slots(self.max_gap_s) if mode else self.new_scenes()
        return super().train(mode)

    def new_scenes(self) -> Scenes:
        """Return empty memories of scenes."""
        return Scenes(self.max_gap_s)

    def new_stream(self) -> MapStream:
        """Return the empty memory of one scene, which a caller keeps."""
        stream = MapStream(self.max_gap_s)
        stream.claim(self)
        return stream

    @contextmanager
    def using(self, stream: Scenes) -> Iterator[None]:
        """Take a caller's own stream for a while; ValueError if it is another model's."""
        stream.claim(self)
        own, self.streams = self.streams, stream
        try:
            yield
        finally:
            self.streams = own

    @contextmanager
    def over(
        self, outputs: dict[str, Any], metas: Sequence[Mapping[str, Any]]
    ) -> Iterator[Remembering]:
        """Give a batch its memory, and keep what it leaves if nothing fails.

        Args:
            outputs: What the encoder returns; ``bev_feats`` (B, C, H, W) is fused.
            metas: Metainfo of each sample.

        Yields:
            The batch with its memory.
        """
        if self.training and self.bev is None and self.queries is None:
            yield Remembering(outputs)  # elements take no part in training, so need no poses
            return
        frames = [Frame.of(meta) for meta in metas]
        before = self.streams.previous(frames)
        batch = self.enter(outputs, recalled(frames, before, outputs["bev_feats"].device))
        yield batch
        left = self.left(batch)
        self.streams.keep(
            [
                StreamState(frame, {name: values[index] for name, values in left.items()})
                for index, frame in enumerate(frames)
            ]
        )

    def enter(self, outputs: dict[str, Any], past: Past) -> Remembering:
        """Return a batch with its memory, as `over` yields it."""
        feats = outputs["bev_feats"]
        if self.bev is not None:
            with torch.autocast(feats.device.type, enabled=False):
                feats = self.bev(feats.float(), past)
        propagation = None if self.queries is None else Propagation(self.queries, past)
        return Remembering({**outputs, "bev_feats": feats}, past, propagation)

    def updated(
        self, batch: Remembering, results: Sequence[InstanceData]
    ) -> Sequence[InstanceData]:
        """Return a batch's detections, updated by those of the frame before, which they replace."""
        if self.elements is None or batch.past is None:
            return results
        results = self.elements.updated(results, batch.past)
        batch.elements_left = self.elements.left(results)
        return results

    def left(self, batch: Remembering) -> dict[str, Tensor]:
        """Return what a batch leaves after its head, by name, without gradient. (B, ...) each"""
        left = dict(batch.elements_left)
        if self.bev is not None:
            left["bev_feats"] = self.bev.kept(batch.outputs["bev_feats"])
        if batch.propagation is not None:
            left |= batch.propagation.left()
        return {
            name: values.half() if self.half and not name.startswith(_EXACT) else values
            for name, values in left.items()
        }


def recalled(
    frames: Sequence[Frame], before: Sequence[StreamState | None], device: torch.device
) -> Past:
    """Return what the frames' streams have left, on a device."""
    pairs = list(zip(frames, before, strict=True))
    motions = [np.eye(4) if s is None else frame.motion_from(s.frame) for frame, s in pairs]
    seconds = [0.0 if s is None else frame.seconds_after(s.frame) for frame, s in pairs]
    like = next((state.values for state in before if state is not None), {})
    memory = {
        name: torch.stack([torch.zeros_like(v) if s is None else s.values[name] for s in before])
        for name, v in like.items()
    }
    moves = [
        torch.from_numpy(np.stack(motions)),
        torch.tensor(seconds, dtype=torch.float64),
        torch.tensor([state is not None for state in before]),
    ]
    remembered = {name: values.to(device) for name, values in memory.items()}
    return Past(remembered, *uploaded(moves, device))
