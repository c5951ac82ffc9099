"""HDMapNet: the vectorising step."""

import random
from collections.abc import Iterator

import numpy as np
import torch
from reference.golden import Golden
from reference.registry import check
from reference.report import Row, largest_difference

from gsmap.models.hdmapnet.vectorizing import (
    VectorizeConfig,
    clean_mask,
    cluster_pixels,
    order_by_distance,
    ridge_pixels,
    sort_along_longer_side,
    top_directions,
    vectorize,
)

SETS = ("closed", "many", "hand")
CLASSES = 3


@check("hdmapnet_post_{variant}.npz")
def check_vectorizing(golden: Golden, name: str) -> Iterator[Row]:
    """Compare clusters, ridges, their order, and the lines of two random starts."""
    data = golden.read_arrays(name)
    masks = golden.read_arrays(name.replace("post", "targets"))
    for chosen in SETS:
        parts = (masks[f"{chosen}_{k}"] for k in ("instance_by_class", "forward", "backward"))
        made = golden.recipe("hdmapnet").post_inputs(chosen, *parts, golden.seed)
        own = {k[len(chosen) + 1 :]: v for k, v in data.items() if k.startswith(f"{chosen}_")}
        maps = tuple(torch.from_numpy(values) for values in made)
        yield from step_rows(name, chosen, maps, own)
        for seed in (0, 1):
            yield from line_rows(name, f"{chosen}_seed{seed}", maps, own, seed)


def step_rows(name: str, chosen: str, maps: tuple, own: dict) -> Iterator[Row]:
    """Compare the steps before the lines."""
    config = VectorizeConfig()
    probs, embedding = maps[0].softmax(0).numpy(), maps[1].numpy()
    best = probs.argmax(0)
    clusters, ridges, ordered = [], [], []
    for label in range(1, CLASSES + 1):
        mask = clean_mask(best == label, config.min_area_px)
        found = cluster_pixels(mask, embedding, config)
        ridge = ridge_pixels(np.where(found > 0, probs[label], 0), config.ridge_tolerance)
        clusters.append(found)
        for number in range(1, found.max() + 1):
            points = sort_along_longer_side(found == number, ridge)
            if len(points):  # a cluster without ridge makes no line
                ridges.append(points)
                ordered.append(order_by_distance(points))
    exact = {
        "semantic_argmax": best,
        "top2": top_directions(maps[2]),
        "cluster": np.stack(clusters),
        "skeleton": np.concatenate(ridges),
        "skeleton_count": np.array([len(points) for points in ridges]),
        "sorted": np.concatenate(ordered),
        "sorted_count": np.array([len(points) for points in ordered]),
    }
    for key, value in exact.items():
        yield Row(name, f"{chosen}_{key}", largest_difference(value, own[key]), 0)


def line_rows(name: str, tag: str, maps: tuple, own: dict, seed: int) -> Iterator[Row]:
    """Compare the lines that begin where a random generator says."""
    chance = random.Random(seed)
    lines = vectorize(*maps, choose_start=chance.randrange)
    seeded = tag.rsplit("_", 1)[1]
    exact = {
        f"{seeded}_coords": np.concatenate([line.pixels for line in lines]),
        f"{seeded}_coords_count": np.array([len(line.pixels) for line in lines]),
        "type": np.array([line.label for line in lines]),
    }
    for key, value in exact.items():
        yield Row(name, f"{tag}: {key}", largest_difference(value, own[key]), 0)
    scores = np.array([line.score for line in lines])
    off = largest_difference(scores, own["confidence"])
    yield Row(name, f"{tag}: confidence", off, 1e-5)
