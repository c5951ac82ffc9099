"""The small networks that turn states into predictions, codes and embeddings."""

from itertools import pairwise

from torch import nn


def mlp(*dims: int) -> nn.Sequential:
    """Return matrices from each number of channels to the next, with ReLUs in between."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(dims):
        layers += [nn.Linear(inputs, outputs), nn.ReLU(True)]
    return nn.Sequential(*layers[:-1])


def classification_branch(embed_dims: int, num_classes: int) -> nn.Sequential:
    """Return a classifier of two hidden layers, each with LayerNorm; it gives logits."""
    layers: list[nn.Module] = []
    for _ in range(2):
        layers += [nn.Linear(embed_dims, embed_dims), nn.LayerNorm(embed_dims), nn.ReLU(True)]
    return nn.Sequential(*layers, nn.Linear(embed_dims, num_classes))
