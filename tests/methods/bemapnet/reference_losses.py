"""BeMapNet: matching and losses, of masks at the recipe's random points and of all pixels."""

from collections.abc import Iterator, Mapping
from itertools import product
from unittest.mock import patch

import numpy as np
import torch
from methods.bemapnet.reference import KEYS, BezierParts, small_head
from reference.golden import Golden
from reference.registry import check
from reference.report import Row, largest_difference, largest_relative, relative_norm
from torch import Tensor

from gsmap.models.bemapnet.head import BezierHead
from gsmap.models.bemapnet.losses import TrueCurves
from gsmap.models.lines.head import LinePredictions

QUERIES, CLASSES, LAYERS, BATCH = (8, 7, 9), 3, 2, 2
MAP = (100, 50)
# the file's two layers have the first weights of each list
LAYER_WEIGHTS, LEVEL_WEIGHTS = (0.4, 0.4), (0.5, 0.8)
NAMES = {
    "mask": "msk",
    "cls": "obj",
    "controls": "ctr",
    "pieces": "end",
    "curve": "curve",
    "recovery": "recovery",
    "semantic": "sem",
}
Arrays = Mapping[str, np.ndarray]
Leaves = dict[tuple[int, int], dict[str, Tensor]]


@check("bemapnet_losses_{variant}.npz")
def check_losses(golden: Golden, name: str) -> Iterator[Row]:
    """Compare matches, losses and gradients."""
    data, parts = golden.read_arrays(name), BezierParts(golden)
    for tag, points in (("points", 1000), ("dense", None)):
        head = small_head(QUERIES, 0.6, losses={"mask_points": points})
        head.layer_weights, head.level_weights = LAYER_WEIGHTS, LEVEL_WEIGHTS
        yield from loss_rows(parts, name, head, tag, data)


class Draws:
    """The recipe's random points, one array a call, in place of ``torch.rand``."""

    def __init__(self, golden: Golden) -> None:
        self.golden, self.shapes = golden, []  # type: tuple[Golden, list[tuple[int, ...]]]

    def __call__(self, *shape: int, device: torch.device | None = None) -> Tensor:
        """Return the next points."""
        name = f"bm_rand_points_{len(self.shapes)}"
        self.shapes.append(shape)
        made = self.golden.inputs.uniform(name, shape, 0, 1, self.golden.seed)
        return torch.from_numpy(made).to(device)


def truths_of(head: BezierHead, data: Arrays) -> list[list[TrueCurves]]:
    """Return what is annotated in each sample, by class."""
    samples = []
    for sample in range(BATCH):
        by_class = []
        for label, curve in enumerate(head.curves):
            arrays = (data[f"gt_b{sample}c{label}_{key}"] for key in ("ctr", "end", "mask"))
            controls, pieces, masks = map(torch.from_numpy, arrays)
            by_class.append(TrueCurves(controls, pieces, curve(controls, pieces), masks.float()))
        samples.append(by_class)
    return samples


def leaves_of(parts: BezierParts, truths: list[list[TrueCurves]], data: Arrays) -> Leaves:
    """Return the predictions of each layer and class."""
    leaves = {}
    for layer, label in product(range(LAYERS), range(CLASSES)):
        tag, number = f"l{layer}c{label}", QUERIES[label]
        own = {key: torch.from_numpy(data[f"{tag}_in_{key}"]) for key in KEYS}
        imitated = [
            torch.stack([truth[label].masks[i] if i >= 0 else torch.zeros(MAP) for i in chosen])
            for truth, chosen in zip(truths, data[f"{tag}_imitates"], strict=True)
        ]
        noise = parts.normal(f"bm_{tag}_mask", (BATCH, number, *MAP), shift=-1)
        own["mask"] = noise + 4 * torch.stack(imitated)
        own["obj"] = parts.normal(f"bm_{tag}_obj", (BATCH, number, 2))
        own["sem"] = parts.normal(f"bm_{tag}_sem", (BATCH, 2, *MAP))
        leaves[layer, label] = {key: value.requires_grad_() for key, value in own.items()}
    return leaves


def loss_rows(
    parts: BezierParts, name: str, head: BezierHead, tag: str, data: Arrays
) -> Iterator[Row]:
    """Compare matches, losses and gradients of one way to compare masks."""
    truths = truths_of(head, data)
    leaves = leaves_of(parts, truths, data)
    outputs, levels, nothing = [], [], torch.empty(0)
    for layer in range(LAYERS):
        own = [leaves[layer, label] for label in range(CLASSES)]
        lines = [
            head.build_lines(label, *(leaf[key] for key in KEYS), leaf["obj"], leaf["mask"])
            for label, leaf in enumerate(own)
        ]
        outputs.append(LinePredictions(nothing, nothing, lines))
        levels.append(torch.cat([leaf["sem"][:, 1:] for leaf in own], 1))
    draws = Draws(parts.golden)
    with patch.object(torch, "rand", draws):
        losses, matches = head.line_losses(outputs, truths, ["first", "second"])
        losses["semantic"] = head.semantic_loss(levels, truths)
    off = largest_difference(np.reshape(draws.shapes, (-1, 3)), data[f"{tag}_rand_shapes"])
    yield Row(name, f"{tag}: numbers of random points", off, 0)
    wrong = 0.0
    for (layer, label), found in zip(product(range(LAYERS), range(CLASSES)), matches, strict=True):
        for sample, pairs in enumerate(found):
            expected = data[f"{tag}_match_l{layer}c{label}b{sample}"]
            wrong = max(wrong, largest_difference(torch.stack(pairs, 1), expected))
    yield Row(name, f"{tag}: pairs of prediction and ground truth", wrong, 0)
    for ours, theirs in NAMES.items():
        off = largest_relative(losses[ours].detach(), data[f"{tag}_{theirs}_loss"])
        yield Row(name, f"{tag}: {ours} (relative)", off, 1e-4)
    total = torch.stack(list(losses.values())).sum()
    off = largest_relative(total.detach(), data[f"{tag}_total"])
    yield Row(name, f"{tag}: total (relative)", off, 1e-4)
    total.backward()
    for key in (*KEYS, "mask", "obj", "sem"):
        off = 0.0
        for (layer, label), leaf in leaves.items():
            gradient = torch.zeros_like(leaf[key]) if leaf[key].grad is None else leaf[key].grad
            if key in ("mask", "sem"):
                gradient = gradient[..., ::5, ::5]
            wanted = data[f"{tag}_grad_{key}_l{layer}c{label}"]
            off = max(off, relative_norm(gradient, wanted))
        yield Row(name, f"{tag}: gradient of {key} (relative)", off, 1e-3)
