"""StreamMapNet: the training head over a stream of frames, with its memory and its gradients."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from methods.streammapnet.reference import (
    BATCH,
    COLS,
    FRAMES,
    GRIDS,
    ROWS,
    StreamParts,
    differing,
    flipped,
    gradients_of,
    metas_of,
)
from mmengine.structures import InstanceData
from predictions import stacked, triples
from reference.golden import Golden
from reference.registry import check
from reference.report import Row, largest_difference, largest_relative, relative_norm
from torch import Tensor

from gsmap.models.base.head import MapHead
from gsmap.models.streams.memory import StreamMemory
from gsmap.models.streams.query_memory import Propagation
from gsmap.structures.polylines import sampled_orders
from gsmap.structures.streams import Frame

QUERIES, KEPT = 24, 10
LAYERS = 6


def truth_of(data: Mapping[str, np.ndarray], key: str, head: MapHead) -> InstanceData:
    """Return a sample's targets from its normalised lines."""
    lines = head.reference.metres(torch.from_numpy(data[f"gt_fixed_{key}"]).double()).numpy()
    closed = data[f"gt_is_closed_{key}"]
    orders = [sampled_orders(*each) for each in zip(lines, closed, strict=True)]
    return InstanceData(
        labels_3d=torch.from_numpy(data[f"gt_labels_{key}"]),
        pts=torch.from_numpy(lines),
        pts_shifts=torch.from_numpy(np.stack(orders)),
    )


class Recorder:
    """Runs a head over the frames of a stream and keeps what the reference has."""

    def __init__(self, head: MapHead, memory: StreamMemory) -> None:
        self.head, self.memory = head, memory
        self.values: dict[str, list[Tensor]] = {}
        self.matches: dict[str, Any] = {}
        self.total = self.trans = torch.zeros(())

    def keep(self, **values: Tensor) -> None:
        """Keep a frame's values."""
        for key, value in values.items():
            self.values.setdefault(key, []).append(value.detach())

    def run(self, data: Mapping[str, np.ndarray], frame: int, bev: Tensor) -> None:
        """Run one frame."""
        metas = metas_of(data, frame)
        frames = [Frame.from_meta(meta) for meta in metas]
        first = [state is None for state in self.memory.streams.previous(frames)]
        gts = [truth_of(data, f"t{frame}_b{slot}", self.head) for slot in range(BATCH)]
        layer_in: list[tuple] = []
        hook = self.head.decoder.layers[1].register_forward_pre_hook(
            lambda _, args: layer_in.append(args)
        )
        own_match = self.head.match

        def match(*args: Any, **kwargs: Any) -> Any:
            pairs = own_match(*args, **kwargs)
            for layer, matches in enumerate(triples(pairs)):
                for slot, each in enumerate(matches):
                    self.matches[f"match_t{frame}_l{layer}_b{slot}"] = each
            return pairs

        self.head.match = match  # type: ignore[method-assign]
        with self.memory.remember_batch({"bev_feats": flipped(bev)}, metas) as batch:
            memory = batch.propagation
            predictions = self.head(batch.outputs, **batch.hooks)
            losses = self.head.loss_by_feat(predictions, gts, metas, [memory])
            trans = memory.loss(self.head)
        hook.remove()
        self.head.match = own_match  # type: ignore[method-assign]
        total = sum(losses.values()) + trans
        self.total, self.trans = self.total + total, self.trans + trans
        names = [f"d{n}." for n in range(LAYERS - 1)] + [""]
        self.keep(
            is_first=torch.tensor(first),
            lines=stacked(predictions).pts.flatten(3),
            scores=stacked(predictions).scores,
            layer0_scores_max=predictions[0].scores.amax(-1),
            layer_in=layer_in[0][0].transpose(0, 1)[..., ::8],
            layer1_ref=mirrored(layer_in[0][2].unflatten(1, (QUERIES, -1))),
            loss_cls=torch.stack([losses[f"{n}loss_cls"] for n in names]),
            loss_reg=torch.stack([losses[f"{n}loss_pts"] for n in names]),
            frame_total_loss=total,
            trans_loss=trans,
            mem_topk=memory.best_inds,
        )
        self.keep_memory(memory, predictions[-1].scores)

    def keep_memory(self, memory: Propagation, scores: Tensor) -> None:
        """Keep what entered from the memory, and what stays in it."""
        states = [state.values for state in self.memory.streams.states]
        self.keep(
            mem_scores=scores.amax(-1).topk(KEPT + 1).values,
            mem_query=torch.stack([state["queries_0"] for state in states])[:, :, 0, ::4],
            mem_ref=torch.stack([state["references"] for state in states]),
            mem_target=torch.stack([state["targets"] for state in states]),
        )
        inserted = torch.full((BATCH, KEPT, 128), torch.nan)
        if memory.propagated is not None:
            inserted = memory.propagated.state[:, :, 0, ::4].detach()
        self.keep(prop_query=inserted, pose12=memory.past.now_from_then[:, :3].flatten(1).float())


def mirrored(points: Tensor) -> Tensor:
    """Return points with y measured from the other edge. (..., 2)"""
    return torch.stack([points[..., 0], 1 - points[..., 1]], -1)


TOLERANCES = {
    "is_first": 0, "lines": 3e-5, "scores": 3e-4, "layer0_scores_max": 3e-4, "layer_in": 3e-4,
    "layer1_ref": 3e-5, "mem_topk": 0, "mem_scores": 3e-4, "mem_query": 3e-4, "mem_ref": 3e-5,
    "mem_target": 1e-5,
}  # fmt: skip


def recorded(golden: Golden, data: Mapping[str, np.ndarray]) -> tuple[Recorder, list[Tensor]]:
    """Run all frames; return what was kept, and the features."""
    parts = StreamParts(golden)
    head = parts.load(parts.head(GRIDS["r60_"], QUERIES), "map_head.").train()
    memory = StreamMemory(head, queries={"num": KEPT})
    parts.load(memory, "temporal.").train()
    shape = (BATCH, 256, ROWS, COLS)
    feats = [parts.normal(f"smn_head_bev_t{t}", shape).requires_grad_() for t in range(FRAMES)]
    recorder = Recorder(head, memory)
    for frame, bev in enumerate(feats):
        recorder.run(data, frame, bev)
    return recorder, feats


@check("streammapnet_stream_{variant}.npz")
def check_stream(golden: Golden, name: str) -> Iterator[Row]:
    """Compare four frames of two streams, and the gradients of all."""
    data, parts = golden.read_arrays(name), StreamParts(golden)
    recorder, feats = recorded(golden, data)
    head, memory = recorder.head, recorder.memory
    values = {key: torch.stack(each) for key, each in recorder.values.items()}
    for key, tolerance in TOLERANCES.items():
        yield Row(name, key, largest_difference(values[key], data[key]), tolerance)
    for key in ("loss_cls", "loss_reg", "frame_total_loss", "trans_loss"):
        off = largest_relative(values[key], data[key])
        yield Row(name, f"{key} (relative)", off, 1e-4)
    continued = ~data["is_first"]
    for key, tolerance in {"prop_query": 3e-4, "pose12": 1e-4}.items():
        off = largest_difference(values[key].numpy()[continued], data[key][continued])
        yield Row(name, key, off, tolerance)
    wrong = [key for key, m in recorder.matches.items() if differing(m, data[key])]
    yield Row(name, "matches that differ", len(wrong), 0)
    start = head.reference.start(head.queries()[0]).unflatten(-1, (-1, 2)).detach()
    yield Row(name, "init_reference", largest_difference(start, data["init_reference"]), 1e-5)
    yield from kept_rows(name, data, recorder)
    yield from decoded_rows(name, data, head, values)
    recorder.trans.backward(retain_graph=True)
    gradients = stream_gradients(head, memory)
    own = {key.removeprefix("trans_"): value for key, value in data.items() if "trans_" in key}
    moved = {key: value for key, value in gradients.items() if value.abs().sum() > 0}
    for row in parts.gradient_rows(name, "", own, moved):
        yield Row(row.file, f"trans_{row.quantity}", row.deviation, row.tolerance)
    for module in (head, memory):
        module.zero_grad()
    for value in feats:
        value.grad = None
    recorder.total.backward()
    off = relative_norm(
        torch.stack([value.grad for value in feats])[:, :, ::16], data["grad_bev_sub"]
    )
    yield Row(name, "gradient of BEV (relative)", off, 1e-2)
    embedding = head.instance_embedding.weight.grad[:, ::4]
    off = relative_norm(embedding, data["grad_query_embedding_sub"])
    yield Row(name, "gradient of the queries (relative)", off, 1e-2)
    yield from parts.gradient_rows(name, "", data, stream_gradients(head, memory))


def stream_gradients(head: MapHead, memory: StreamMemory) -> dict[str, Tensor]:
    """Return all gradients by upstream's key."""
    return {**gradients_of(head, "map_head."), **gradients_of(memory, "temporal.")}


def kept_rows(name: str, data: Mapping[str, np.ndarray], recorder: Recorder) -> Iterator[Row]:
    """Compare which own queries of the first layer stay, best first."""
    scores = torch.stack(recorder.values["layer0_scores_max"])
    kept = scores.topk(QUERIES - KEPT).indices.numpy()
    continued = ~data["is_first"]
    yield Row(name, "kept", largest_difference(kept[continued], data["kept"][continued]), 0)


def decoded_rows(
    name: str, data: Mapping[str, np.ndarray], head: MapHead, values: Mapping[str, Tensor]
) -> Iterator[Row]:
    """Compare the detections of the last frame's first sample."""
    scores, lines = values["scores"][-1, -1, 0], values["lines"][-1, -1, 0].unflatten(-1, (20, 2))
    metres = head.reference.metres(lines)
    best = head.coder.decode(scores, metres)
    back = best.query_inds.argsort()
    off = largest_difference(best.scores[back], data["post_scores"])
    yield Row(name, "post_scores", off, 3e-4)
    yield Row(name, "post_labels", largest_difference(best.labels[back], data["post_labels"]), 0)
    wanted = data["post_vectors"]
    ours = metres if np.abs(wanted).max() > 1.5 else lines
    yield Row(name, "post_vectors", largest_difference(ours, wanted), 3e-3)
