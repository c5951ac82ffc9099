"""Masks and settings that every backend of the raster loss is tested on."""

import torch

SETTINGS = [
    {},
    {"window_size": 5, "foreground_weight": 3.0, "alpha": 0.3},
    {"alpha": 1.0, "foreground_weight": 5.0},
    {"alpha": 0.0},
]


def sparse_masks(shape, share, seed=0):
    generator = torch.Generator().manual_seed(seed)
    masks = torch.rand(2, *shape, generator=generator)
    return masks * (torch.rand(2, *shape, generator=generator) < share)


MASKS = {
    "dense": (sparse_masks((21, 33), 0.3), sparse_masks((21, 33), 0.3, seed=1)),
    "sparse": (sparse_masks((21, 33), 0.005), sparse_masks((21, 33), 0.005, seed=1)),
    "smaller than the window": (sparse_masks((7, 4), 0.3), sparse_masks((7, 4), 0.3, seed=1)),
    "one pixel": (sparse_masks((1, 1), 1.0), sparse_masks((1, 1), 1.0, seed=1)),
    "faint": (1e-3 * sparse_masks((21, 33), 0.3), 1e-2 * sparse_masks((21, 33), 0.3, seed=1)),
    "empty prediction": (torch.zeros(2, 7, 9), sparse_masks((7, 9), 0.3)),
    "empty target": (sparse_masks((7, 9), 0.3), torch.zeros(2, 7, 9)),
    "both empty": (torch.zeros(2, 7, 9), torch.zeros(2, 7, 9)),
}
