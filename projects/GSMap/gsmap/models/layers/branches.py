"""The small networks that turn a decoder's states into predictions."""

from torch import nn


def classification_branch(embed_dims: int, num_layers: int, num_classes: int) -> nn.Sequential:
    """Return a classifier of ``num_layers`` hidden layers, each with LayerNorm; it gives logits."""
    layers: list[nn.Module] = []
    for _ in range(num_layers):
        layers += [nn.Linear(embed_dims, embed_dims), nn.LayerNorm(embed_dims), nn.ReLU(True)]
    return nn.Sequential(*layers, nn.Linear(embed_dims, num_classes))


def regression_branch(embed_dims: int, num_layers: int, out_dims: int) -> nn.Sequential:
    """Return a regressor of ``out_dims`` numbers with ``num_layers`` hidden layers."""
    layers: list[nn.Module] = []
    for _ in range(num_layers):
        layers += [nn.Linear(embed_dims, embed_dims), nn.ReLU(True)]
    return nn.Sequential(*layers, nn.Linear(embed_dims, out_dims))
