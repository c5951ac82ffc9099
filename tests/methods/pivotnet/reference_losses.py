"""PivotNet's targets, matching, losses and what is decoded."""

from collections.abc import Iterable, Iterator, Mapping
from itertools import product
from typing import ClassVar

import numpy as np
import torch
from methods.pivotnet.reference import PivotParts, decoded_rows
from mmdet3d.structures import Det3DDataSample
from reference.golden import Golden
from reference.lines import elements
from reference.registry import check
from reference.report import Row, largest_difference, largest_relative, relative_norm
from scipy.ndimage import binary_dilation

from gsmap.models.lines.head import LinePredictions
from gsmap.models.pivotnet.head import PivotHead, pack_lines
from gsmap.models.pivotnet.losses import Lines
from gsmap.models.pivotnet.matching import match_pivots, path_costs, sequence_costs
from gsmap.models.pivotnet.targets import FormatPivotTargets
from gsmap.structures.grid import BEVGrid

GRID = BEVGrid((-15.0, 15.0), (-30.0, 30.0))


@check("pivotnet_matching_{variant}.npz")
def check_matching(golden: Golden, name: str) -> Iterator[Row]:
    """Compare both dynamic programmes."""
    data = golden.read_arrays(name)
    recipe = golden.recipe("pivotnet")
    wrong = 0
    off = 0.0
    num_cases = sum(key.startswith("dp_size") for key in data)
    for index in range(num_cases):
        shape = tuple(data[f"dp_size{index}"])
        costs = recipe.uniform(f"pv_cost{index}", shape, seed=golden.seed)
        wrong += not np.array_equal(match_pivots(costs), data[f"dp_match{index}"])
        off = max(off, largest_relative(path_costs(costs)[-1, -1], data[f"dp_cost{index}"]))
    tied = data["dp_tie_input"]
    wrong += not np.array_equal(match_pivots(tied), data["dp_tie_match"])
    off = max(off, largest_relative(path_costs(tied)[-1, -1], data["dp_tie_cost"]))
    yield Row(name, "paths that differ", wrong, 0)
    batch = recipe.uniform("pv_cost_batch", (5, 10, 10), seed=golden.seed).astype(float)
    for weight in (0, 5):
        ours = sequence_costs(batch[None], data["batch_lens"], weight)[0]
        wanted = data[f"batch_cost_endpoints{weight}"]
        differing = (np.isinf(ours) ^ np.isinf(wanted)).sum()
        yield Row(name, f"lines without a path, ends + {weight}", differing, 0)
        finite = np.isfinite(wanted)
        off = max(off, largest_relative(ours[finite], wanted[finite]))
    yield Row(name, "costs (relative)", off, 1e-6)


@check("pivotnet_pivots_{variant}.npz")
def check_pivots(golden: Golden, name: str) -> Iterator[Row]:
    """Compare lines, pivots and masks of the ground truth."""
    data = golden.read_arrays(name)
    grid = GRID.rasterized(0.15)
    for tag in ("closed", "many"):
        thick = FormatPivotTargets()
        parts = []  # class and points of each line
        for element in elements(golden, tag):
            for line in thick.lines(element, grid):
                parts.append((element.label, line))
        labels = np.array([label for label, _ in parts])
        off = largest_difference(labels, data[f"{tag}_lines_kept_pivot_types"])
        yield Row(name, f"{tag}: classes of lines", off, 0)
        offs = []
        for i, (_, line) in enumerate(parts):
            pixels = (line * (400, 200))[:, ::-1]
            offs.append(largest_difference(pixels, data[f"{tag}_map_pivot_input{i}"]))
        yield Row(name, f"{tag}: lines (pixels)", max(offs), 1e-4)
        pivots = []
        pivots_of_class: list[list[np.ndarray]] = [[], [], []]
        for label, line in parts:
            points = thick.points(line, label, grid)
            pivots.append(points)
            pivots_of_class[label].append(points)
        for label, own in enumerate(pivots_of_class):
            numbers = [len(line) for line in own]
            off = largest_difference(numbers, data[f"{tag}_lengths{label}"])
            yield Row(name, f"{tag}: numbers of pivots {label}", off, 0)
            offs = []
            for line, row in zip(own, data[f"{tag}_pivots{label}"], strict=True):
                offs.append(largest_difference(line, row[: len(line)]))
            yield Row(name, f"{tag}: pivots {label}", max(offs, default=0), 1e-9)
        masks, _ = thick.masks(parts, pivots, (400, 200))
        drawn = np.zeros((3, 400, 200), int)
        for number, (mask, label) in enumerate(zip(masks, labels, strict=True)):
            drawn[label][mask] = 2 * number + 2
        off = largest_difference(drawn, data[f"{tag}_mask8"])
        yield Row(name, f"{tag}: masks of width 8", off, 0)
        # no loss reads the masks of width 1, and versions of OpenCV draw such lines differently
        lines, _ = FormatPivotTargets(thickness_px=1).masks(parts, pivots, (400, 200))
        thin = np.stack([lines[labels == label].any(0) for label in range(3)])
        wanted = data[f"{tag}_mask1"] > 0
        far = (thin & ~wide(wanted)).sum() + (wanted & ~wide(thin)).sum()
        yield Row(name, f"{tag}: pixels of width 1 that are more than one off", far, 0)


def wide(masks: np.ndarray) -> np.ndarray:
    """Return masks widened by one pixel. (n, H, W)"""
    return binary_dilation(masks, np.ones((1, 3, 3)))


class Given:
    """The recipe's predictions of all layers on a map of 100 x 50 pixels."""

    SHAPES: ClassVar = {  # our part of a line: its name, its shape behind the lines
        "logits": ("obj", (2,)),
        "points": ("ctr", (2,)),
        "point_logits": ("pt", (2,)),
        "masks": ("mask", (100, 50)),
    }

    def __init__(self, parts: PivotParts, head: PivotHead, tag: str, layers: Iterable[int]) -> None:
        self.parts = parts
        self.tag = tag
        self.layers: list[list[Lines]] = []
        for i in layers:
            classes = []
            for j, (n, p) in enumerate(head.decoder.queries):
                classes.append(self.lines(f"{i}_{j}", n, p))
            self.layers.append(classes)

    def lines(self, number: str, n: int, p: int) -> Lines:
        """Return the lines of a layer and class."""
        parts = {}
        for ours, (theirs, shape) in self.SHAPES.items():
            full = (1, n, p, *shape) if "point" in ours else (1, n, *shape)
            key = f"{self.tag}{theirs}{number}"
            if ours == "points":
                seed = self.parts.golden.seed
                made = self.parts.recipe.uniform(key, full, 0.02, 0.98, seed)
                parts[ours] = torch.from_numpy(made)
            else:
                parts[ours] = self.parts.normal(key, full, shift=-float(ours == "masks"))
            parts[ours].requires_grad_()
        return Lines(**parts)


LOSS_NAMES = {
    "mask": "ins_msk_loss",
    "cls": "ins_obj_loss",
    "pivots": "pts_loss",
    "collinear": "collinear_pts_loss",
    "point_cls": "pt_logits_loss",
    "semantic": "sem_msk_loss",
}


@check("pivotnet_losses_{variant}.npz")
def check_losses(golden: Golden, name: str) -> Iterator[Row]:
    """Compare matches, losses, gradients and what is decoded."""
    data = golden.read_arrays(name)
    parts = PivotParts(golden)
    head = parts.head()
    for tag in ("closed", "many", "dividers_only"):
        yield from loss_rows(parts, name, head, tag, data)
    (layer,) = Given(parts, head, "pv_post_", [5]).layers
    detached = []
    for lines in layer:
        detached.append(Lines(*(part.detach() for part in lines)))
    output = pack_lines(detached)
    yield from decoded_rows(name, head, output, data, "post", (100, 50))


def truth_of(golden: Golden, tag: str) -> Det3DDataSample:
    """Return a sample with the targets of a set, with masks of every fourth pixel."""
    if tag == "dividers_only":
        instances = [element for element in elements(golden, "many") if element.label == 0]
    else:
        instances = elements(golden, tag)
    results = {
        "map_instances": instances,
        "token": tag,
        "x_range": GRID.x_range,
        "y_range": GRID.y_range,
    }
    sample = Det3DDataSample()
    sample.gt_instances_3d = FormatPivotTargets().transform(results)["gt_instances_3d"]
    sample.gt_instances_3d.masks = sample.gt_instances_3d.masks[:, ::4, ::4]
    return sample


def loss_rows(
    parts: PivotParts, name: str, head: PivotHead, tag: str, data: Mapping[str, np.ndarray]
) -> Iterator[Row]:
    """Compare matches, losses and gradients with a set of ground truth."""
    given = Given(parts, head, "pv_loss_", range(6))
    semantic = []  # logits of each level and class
    class_masks = []
    for i in range(4):
        level = []
        for j in range(3):
            logits = parts.normal(f"pv_loss_sem{i}_{j}", (1, 2, 100, 50), shift=-1)
            level.append(logits.requires_grad_())
        semantic.append(level)
        class_masks.append(torch.cat([logits[:, 1:] for logits in level], 1))
    truth = head.truth(truth_of(parts.golden, tag))
    nothing = torch.empty(0)
    outputs = [LinePredictions(nothing, nothing, lines) for lines in given.layers]
    losses, matches = head.line_losses(outputs, [truth], [tag])
    losses["semantic"] = head.semantic_loss(class_masks, [truth])
    wrong = 0.0
    paths = []
    for i, j in product(range(6), range(3)):
        (found,) = matches[3 * i + j]
        pairs = torch.stack([found.rows, found.cols], 1)
        expected = data.get(f"{tag}_match_l{i}_c{j}", np.empty((0, 2)))
        wrong = max(wrong, largest_difference(pairs, expected))
        paths += [np.flatnonzero(path) for path in found.is_pivot.numpy()]
    yield Row(name, f"{tag}: pairs of prediction and ground truth", wrong, 0)
    width = data[f"{tag}_pivot_matches"].shape[1]
    filled = []
    for path in paths:
        filled.append(np.pad(path, (0, width - len(path)), constant_values=-1))
    off = largest_difference(np.stack(filled), data[f"{tag}_pivot_matches"])
    yield Row(name, f"{tag}: paths of pivots", off, 0)
    for ours, theirs in LOSS_NAMES.items():
        off = largest_relative(losses[ours].detach(), data[f"{tag}_{theirs}"])
        yield Row(name, f"{tag}: {ours} (relative)", off, 1e-4)
    total = sum(losses.values())
    off = largest_relative(total.detach(), data[f"{tag}_total_loss"])
    yield Row(name, f"{tag}: total (relative)", off, 1e-4)
    total.backward()
    num_compared = 0 if tag == "dividers_only" else 3
    for j in range(num_compared):
        lines = given.layers[5][j]
        gradients = {
            f"ctr_im_l5_c{j}": lines.points.grad,
            f"pts_logits_l5_c{j}": lines.point_logits.grad,
            f"obj_logits_l5_c{j}": lines.logits.grad,
            f"mask_l5_c{j}_sub": lines.masks.grad[:, ::5, ::4, ::4],
            f"sem_l3_c{j}_sub": semantic[3][j].grad[..., ::5, ::5],
        }
        for key, value in gradients.items():
            off = relative_norm(value, data[f"{tag}_grad_{key}"])
            yield Row(name, f"{tag}: gradient {key} (relative)", off, 1e-3)
