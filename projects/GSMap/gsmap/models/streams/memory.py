"""A detector's memory: what its streams have left enters a batch, and what the batch leaves."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from mmdet3d.registry import MODELS
from mmengine.model import BaseModule
from torch import Tensor

from gsmap.models.maptr.head import MapHead
from gsmap.models.streams.bev_memory import BEVMemory
from gsmap.models.streams.query_memory import Propagation, QueryMemory
from gsmap.models.streams.states import Frame, MapStream, Scenes, Slots, StreamState


class StreamMemory(BaseModule):
    """The memory of a `MapDetector`, one state per stream, moved by the poses of the samples.

    In training a stream is a place in the batch (`Slots`), in testing a scene (`Scenes`), whose
    memories are empty at the start of each. Samples have ``scene``, ``timestamp_ns`` and
    ``lidar2global`` in their metainfo.

    Args:
        head: The detector's head.
        bev: Settings of `BEVMemory`, or None without memory of the map's features.
        queries: Settings of `QueryMemory`, or None without memory of queries.
        embed_dims: Channels of the map's features.
        max_gap_s: A longer pause between two frames, in seconds, starts a stream anew.

    Raises:
        ValueError: If there is neither memory, or one does not fit the head.
    """

    def __init__(
        self,
        head: MapHead,
        bev: dict[str, Any] | None = None,
        queries: dict[str, Any] | None = None,
        embed_dims: int = 256,
        max_gap_s: float = 2.0,
    ) -> None:
        super().__init__()
        if bev is None and queries is None:
            raise ValueError("temporal needs bev=dict(...), queries=dict(...) or both.")
        self.max_gap_s = max_gap_s
        self.bev: BEVMemory | None = None
        if bev is not None:
            part = {"type": "BEVMemory", "grid": head.grid, "embed_dims": embed_dims}
            self.bev = MODELS.build({**part, **bev})
        self.queries: QueryMemory | None = None
        if queries is not None:
            part = {"type": "QueryMemory", "embed_dims": head.embed_dims}
            self.queries = MODELS.build({**part, **queries})
            self.queries.check(head)
        self.streams: Slots | Scenes = Slots(max_gap_s)

    def train(self, mode: bool = True) -> "StreamMemory":
        """Switch between training and testing, and forget all streams."""
        self.streams = Slots(self.max_gap_s) if mode else self.new_scenes()
        return super().train(mode)

    def new_scenes(self) -> Scenes:
        """Return empty memories of scenes."""
        return Scenes(self.max_gap_s)

    def new_stream(self) -> MapStream:
        """Return the empty memory of one scene, which a caller keeps."""
        return MapStream(self.max_gap_s)

    @contextmanager
    def using(self, stream: Scenes) -> Iterator[None]:
        """Take a caller's own stream for a while."""
        own, self.streams = self.streams, stream
        try:
            yield
        finally:
            self.streams = own

    @contextmanager
    def over(
        self, outputs: dict[str, Any], metas: Sequence[Mapping[str, Any]]
    ) -> Iterator[dict[str, Any]]:
        """Give a batch its memory, and keep what it leaves if nothing fails.

        Args:
            outputs: What the encoder returns; ``bev_feats`` (B, C, H, W) is fused.
            metas: Metainfo of each sample.

        Yields:
            The outputs, with ``bev_feats`` of all frames so far and ``query_memory`` for the head.
        """
        frames = [Frame.of(meta) for meta in metas]
        before = self.streams.previous(frames)
        feats = outputs["bev_feats"]
        now_from_then = motions(frames, before, feats.device)
        outputs = dict(outputs)
        if self.bev is not None:
            kept = [None if s is None else s.bev_feats for s in before]
            continues = torch.tensor([k is not None for k in kept], device=feats.device)
            memory = stack_or_none(kept, feats)
            with torch.autocast(feats.device.type, enabled=False):
                back = torch.linalg.inv(now_from_then)
                outputs["bev_feats"] = self.bev(feats.float(), memory, back, continues)
        propagation = None
        if self.queries is not None:
            kept_queries = [None if state is None else state.queries for state in before]
            propagation = Propagation(self.queries, kept_queries, now_from_then)
            outputs["query_memory"] = propagation
        yield outputs
        maps = outputs["bev_feats"].detach() if self.bev is not None else [None] * len(frames)
        queries = [None] * len(frames) if propagation is None else propagation.states()
        left = zip(frames, maps, queries, strict=True)
        self.streams.keep([StreamState(*parts) for parts in left])


def motions(
    frames: Sequence[Frame], before: Sequence[StreamState | None], device: torch.device
) -> Tensor:
    """Return what takes metres then to metres now, the identity where a stream starts. (B, 4, 4)"""
    each = [
        np.eye(4) if state is None else frame.motion_from(state.frame)
        for frame, state in zip(frames, before, strict=True)
    ]
    return torch.as_tensor(np.stack(each), device=device)


def stack_or_none(parts: Sequence[Tensor | None], like: Tensor) -> Tensor | None:
    """Stack the streams' maps, zeros where a stream starts; None if all do. (B, C, H, W)"""
    if all(part is None for part in parts):
        return None
    return torch.stack([torch.zeros_like(like[0]) if p is None else p.to(like) for p in parts])
