"""Groups of instance queries: one-to-one queries that predict, further ones that help training."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from mmengine.logging import print_log
from torch import Tensor


@dataclass(frozen=True)
class QueryGroup:
    """Instance queries that are matched together; no group attends to another.

    Args:
        num: Instance queries.
        name: Suffix of its losses; empty for the group that predicts.
        repeats: How often each ground truth may be matched (k in MapTRv2).
        weight: Weight of its losses (lambda in MapTRv2).
        losses: Names of the losses that it has; None means all.

    Raises:
        ValueError: If a number is not positive.
    """

    num: int
    name: str = ""
    repeats: int = 1
    weight: float = 1.0
    losses: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        if self.num < 1 or self.repeats < 1:
            raise ValueError(
                f"a query group needs num >= 1 and repeats >= 1, got {self.num} and {self.repeats}."
            )

    def has(self, loss: str) -> bool:
        """Return whether the group has a loss."""
        return self.losses is None or loss in self.losses


def group_mask(groups: Sequence[QueryGroup], device: torch.device) -> Tensor:
    """Return True for pairs of instances of two groups. (N, N)"""
    sizes = torch.tensor([group.num for group in groups], device=device)
    owner = torch.arange(len(groups), device=device).repeat_interleave(sizes)
    return owner[:, None] != owner


def fit_instance_queries(
    state: dict[str, Tensor], key: str, own: Tensor, num_predicting: int
) -> None:
    """Fit the instance queries of a checkpoint, in place, to a model's (N, 2 C).

    The first ones, which predict, are taken as they are. Surplus further queries are cut off;
    missing ones keep their initial values. A log line says so.
    """
    loaded = state.get(key)
    if loaded is None or len(loaded) < num_predicting or loaded.shape == own.shape:
        return
    kept = loaded[: len(own)]
    state[key] = torch.cat([kept, own.detach()[len(kept) :].to(kept)])
    print_log(
        f"{key}: the checkpoint has {len(loaded)} instance queries, the model {len(own)}; the "
        f"{num_predicting} that predict are taken, the further ones cut off or left as new.",
        "current",
        logging.WARNING,
    )
