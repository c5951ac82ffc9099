"""VectorMapNet's polyline generator: teacher forcing, gradients and decoding."""

from collections.abc import Iterator, Mapping
from copy import deepcopy

import numpy as np
import torch
from methods.vectormapnet.reference import GRID, VectorParts
from reference.golden import Golden
from reference.registry import check
from reference.report import Row, largest_difference, largest_relative, relative_norm
from torch import Tensor

from gsmap.models.vectormapnet.canvas import Canvas
from gsmap.models.vectormapnet.generator import Elements, PolylineGenerator, causal_mask
from gsmap.models.vectormapnet.layers import keep_most_likely

MAX_POINTS = 24


def generator_of(parts: VectorParts) -> PolylineGenerator:
    """Return the released generator, as it decodes."""
    generator = deepcopy(parts.head().generator)
    generator.redraw, generator.max_points = True, MAX_POINTS
    return generator


@check("vectormapnet_generator_{variant}.npz")
def check_generator(golden: Golden, name: str) -> Iterator[Row]:
    """Compare the generator with annotated points given: states, laws, loss, gradients."""
    data, parts = golden.read_arrays(name), VectorParts(golden)
    generator = generator_of(parts)
    start = [layer.gates for layer in PolylineGenerator(Canvas(GRID), 3).layers]
    gates = torch.stack([gate.detach() for gates in start for gate in gates])
    yield Row(name, "init_res_weight", largest_difference(gates, 0 * gates), 0)
    mask = causal_mask(9, torch.device("cpu"))
    yield Row(name, "causal_mask", largest_difference(mask, data["causal_mask"]), 0)
    bev = parts.normal("vm_gen_bev", (2, 128, 5, 10)).requires_grad_()
    tokens = torch.from_numpy(data["polylines"]).long()
    boxes, labels = (torch.from_numpy(data[key]).long() for key in ("bbox_flat", "lines_cls"))
    of_image, valid = (
        torch.from_numpy(data["lines_bs_idx"]),
        torch.from_numpy(data["polyline_masks"]),
    )
    weights = torch.from_numpy(data["polyline_weights"])
    total, rows = torch.zeros(()), {"condition": [], "inputs": [], "layers": [], "law": []}
    with torch.no_grad():
        for i, feats in enumerate(bev):
            own = of_image == i
            elements, given = Elements(labels[own], boxes[own]), tokens[own, :-1]
            condition = generator.embed_condition(elements)
            inputs = torch.cat([condition, generator.embed_points(given)], 1)
            rows["condition"].append(condition)
            rows["inputs"].append(inputs[..., ::16])
            states = generator.states(feats, elements, given)
            rows["layers"].append(torch.stack(states)[:, :, ::4, ::16].transpose(1, 2))
            rows["law"].append(generator.log_probs(feats, elements, given))
            if i == 0:
                raw = generator.mask_forbidden(generator.logits(states[-1][:1, 4:]))[0, valid[0]]
                yield Row(
                    name,
                    "raw_logits_line0",
                    largest_difference(raw, data["raw_logits_line0"]),
                    3e-4,
                )
        cells = torch.stack([generator.context(feats[None])[0] for feats in bev])[of_image]
    found = {key: torch.cat(value, 2 if key == "layers" else 0) for key, value in rows.items()}
    law = found["law"]
    at_target = law.gather(-1, tokens[..., None])[..., 0]
    wanted = torch.from_numpy(data["logprob_at_target"])
    ours = {
        "condition": (found["condition"], data["condition"], 1e-5),
        "inputs_sub": (found["inputs"], data["inputs_sub"], 1e-5),
        "memory_sub": (cells.flatten(2).transpose(1, 2)[:, ::5, ::16], data["memory_sub"], 1e-5),
        "layers_sub": (found["layers"], data["layers_sub"], 3e-4),
        "logprob": (law[valid][::3], data["logprob"], 3e-4),
        "logprob_at_target": (at_target * valid, wanted * valid, 3e-4),
    }
    for key, (value, reference, tolerance) in ours.items():
        yield Row(name, key, largest_difference(value, reference), tolerance)
    yield from group_rows(name, generator, bev.detach(), data, at_target)
    for i, feats in enumerate(bev):
        own = of_image == i
        elements = Elements(labels[own], boxes[own])
        total = total + generator.loss(feats, elements, tokens[own], weights[own])
    loss = total / weights.sum()
    yield Row(name, "loss_seq (relative)", largest_relative(loss.detach(), data["loss_seq"]), 1e-4)
    loss.backward()
    off = relative_norm(bev.grad[:, ::8], data["grad_bev"])
    yield Row(name, "grad_bev (relative)", off, 2e-3)
    yield from parts.gradient_rows(name, data, parts.gradients_of(generator, "map_head.generator."))


def group_rows(
    name: str,
    generator: PolylineGenerator,
    bev: Tensor,
    data: Mapping[str, np.ndarray],
    at_target: Tensor,
) -> Iterator[Row]:
    """Compare with the release's groups of lines of similar length, each without longer ones."""
    tokens, of_image = torch.from_numpy(data["polylines"]).long(), data["lines_bs_idx"]
    boxes, labels = (torch.from_numpy(data[key]).long() for key in ("bbox_flat", "lines_cls"))
    off = 0.0
    for key in ("chunk1", "chunk2"):
        for i, feats in enumerate(bev):
            own = [line for line in data[key] if of_image[line] == i]
            if not own:
                continue
            valid = torch.from_numpy(data["polyline_masks"])[own]
            some = tokens[own, : int(valid.sum(1).max())]
            with torch.no_grad():
                law = generator.log_probs(feats, Elements(labels[own], boxes[own]), some[:, :-1])
            short = law.gather(-1, some[..., None])[..., 0]
            apart = (short - at_target[own, : some.shape[1]])[valid[:, : some.shape[1]]]
            off = max(off, float(apart.abs().max()))
    yield Row(name, "one pass against groups", off, 3e-4)


class Given:
    """Tokens that a run of the release drew, and the laws that it drew from."""

    def __init__(self, data: Mapping[str, np.ndarray], tag: str) -> None:
        fed = torch.from_numpy(data[f"{tag}_fed"]).long()
        drawn = torch.from_numpy(data[f"{tag}_polylines"]).long()
        self.fed = torch.cat([fed, drawn[None]])  # nothing is fed behind the last step
        self.drawn, self.laws, self.alive = drawn, [], torch.arange(len(drawn))

    def __call__(self, laws: Tensor) -> Tensor:
        """Return what is fed in the next step; the new token of a line that ends is 0."""
        step = len(self.laws)
        self.laws.append(laws[:, -1])
        tokens = self.fed[step + 1, self.alive, : step + 1].clamp(min=0)
        tokens[:, -1] = self.drawn[self.alive, step]
        self.alive = self.alive[tokens[:, -1] > 0]
        return tokens[:, -laws.shape[1] :]


@check("vectormapnet_decoding_{variant}.npz")
def check_decoding(golden: Golden, name: str) -> Iterator[Row]:
    """Compare greedy lines, the released laws, and the cut of the tail alone."""
    data, parts = golden.read_arrays(name), VectorParts(golden)
    logits = torch.from_numpy(data["topp_in"])
    for key, share in (("05", 0.5), ("09", 0.9), ("0", 0.0)):
        off = largest_difference(keep_most_likely(logits, share), data[f"topp_{key}"])
        yield Row(name, f"topp_{key}", off, 1e-6)
    generator = generator_of(parts)
    bev = parts.normal("vm_gen_bev", (2, 128, 5, 10))
    for share, redraw, tag in (
        (0.0, True, "released"),
        (0.0, False, "cached"),
        (0.9, False, "0.9"),
    ):
        generator.top_p, generator.redraw = share, redraw
        tokens = decoded(generator, bev, data, lambda laws: laws.argmax(-1))
        off = largest_difference(tokens, data["greedy_polylines"])
        yield Row(name, f"greedy_polylines, {tag}", off, 0)
        ends = (tokens == 0).any(1)
        yield Row(
            name, f"greedy_completed, {tag}", largest_difference(ends, data["greedy_completed"]), 0
        )
        kept = torch.arange(tokens.shape[1]) <= (tokens > 0).sum(1, keepdim=True)
        yield Row(name, f"greedy_masks, {tag}", largest_difference(kept, data["greedy_masks"]), 0)
    generator.top_p, generator.redraw = 0.9, True
    for tag in ("nucleus_0", "nucleus_1"):
        given = Given(data, tag)
        tokens = decoded_together(generator, bev, data, given)
        off = largest_difference(tokens, data[f"{tag}_polylines"])
        yield Row(name, f"{tag}: the first tokens are kept", off, 0)
        for step in (0, 1, 4):
            ours, wanted = given.laws[step].numpy(), data[f"{tag}_law{step}"]
            # a token at the border of the cut may be in or out: compare the others' proportions
            border = (ours > 0) != (wanted > 0)
            yield Row(name, f"{tag}: tokens at the border, step {step}", border.sum(1).max(), 1)
            laws = [np.where(border, 0, part) for part in (ours, wanted)]
            both = [part / part.sum(1, keepdims=True) for part in laws]
            yield Row(name, f"{tag}: law {step}", largest_difference(*both), 1e-4)


def decoded(
    generator: PolylineGenerator, bev: Tensor, data: Mapping[str, np.ndarray], draw
) -> Tensor:
    """Return the lines of both images' elements, each image's alone."""
    boxes, labels = (torch.from_numpy(data[k]).long() for k in ("cond_bbox", "cond_cls"))
    of_image = torch.from_numpy(data["cond_bs"])
    parts = [
        generator.generate(feats, Elements(labels[of_image == i], boxes[of_image == i]), draw)
        for i, feats in enumerate(bev)
    ]
    return torch.cat(parts)


def decoded_together(
    generator: PolylineGenerator, bev: Tensor, data: Mapping[str, np.ndarray], given: Given
) -> Tensor:
    """Return the lines of both images with given tokens, and join the laws of both."""
    of_image, laws, tokens = data["cond_bs"], [], []
    for i, feats in enumerate(bev):
        own = of_image == i
        part = {
            "g_fed": given.fed[:-1, own].numpy(),
            "g_polylines": given.drawn[own].numpy(),
        }
        each = Given(part, "g")
        elements = Elements(
            *(torch.from_numpy(data[k][own]).long() for k in ("cond_cls", "cond_bbox"))
        )
        tokens.append(generator.generate(feats, elements, each))
        laws.append(each.laws)
    given.laws = [torch.cat([part[step] for part in laws if step < len(part)]) for step in range(5)]
    return torch.cat(tokens)
