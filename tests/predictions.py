"""Predictions of all layers as stacked tensors, and the way back; pairs of given values."""

from types import SimpleNamespace

import torch
from torch import Tensor

from gsmap.models.maptr.decoder import Decoded
from gsmap.models.maptr.head import MapHead
from gsmap.models.maptr.pairs import Predictions


def stacked(outputs: list[Predictions]) -> SimpleNamespace:
    """Return what is predicted after all layers, each (L, B, N, ...)."""
    values = {"scores": [layer.scores for layer in outputs], "pts": [x.pts for x in outputs]}
    for name in vars(outputs[0].decoded):
        values[name] = [vars(layer.decoded)[name] for layer in outputs]
    return SimpleNamespace(**{name: torch.stack(layers) for name, layers in values.items()})


def predicted(
    head: MapHead,
    scores: Tensor,
    references: Tensor,
    instance_states: Tensor | None = None,
    bev_feats: Tensor | None = None,
    kind: type[Decoded] = Decoded,
    **further: Tensor,
) -> list[Predictions]:
    """Return predictions of a head from values of all layers, each (L, B, N, ...)."""
    states = scores if instance_states is None else instance_states
    values = zip(references, references, states, *further.values(), strict=True)
    layers = (kind(*layer) for layer in values)
    return [head.predictions(*layer, bev_feats) for layer in zip(scores, layers, strict=True)]


def pairs_of(**values: object) -> SimpleNamespace:
    """Return matched pairs of given values, for a loss alone; one pair if none is said."""
    return SimpleNamespace(**{"avg_factor": 1.0, **values})
