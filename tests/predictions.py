"""Predictions of all layers as stacked tensors, and the way back; pairs of given values."""

from types import SimpleNamespace

import torch
from torch import Tensor

from gsmap.models.base.decoder import Decoded
from gsmap.models.base.head import MapHead
from gsmap.models.base.pairs import MatchedPairs, Predictions


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
    """Return matched pairs of one layer, of given values, for a loss; one pair if none is said."""
    one_layer = {"num_layers": 1, "by_layer": lambda of_pairs: of_pairs[None]}
    pairs = SimpleNamespace(**{"avg_factor": 1.0, **one_layer, **values})
    pairs.layer = lambda _: pairs
    return pairs


def triples(pairs: MatchedPairs) -> list[list[Tensor]]:
    """Return query, ground truth and order of the pairs of each layer and sample. (M, 3) each"""
    by_layer = [pairs.layer(number) for number in range(pairs.num_layers)]
    return [
        list(torch.stack([own.query_inds, own.gt_inds, own.order_inds], -1).split(own.counts))
        for own in by_layer
    ]
