"""What a head refuses when it is built: parts that do not fit together."""

from collections.abc import Sequence, Set
from typing import TYPE_CHECKING, Any

from torch import nn

from gsmap.models.maptr.pairs import AFTER_MATCHING, GT_FIELDS, MATCHED_GT_FIELDS

if TYPE_CHECKING:
    from gsmap.models.maptr.head import MapHead


def by_name(modules: Sequence[nn.Module]) -> nn.ModuleDict:
    """Return modules by their ``name``; ValueError if two have the same."""
    _refuse_twins([str(module.name) for module in modules], "parts")
    return nn.ModuleDict({str(module.name): module for module in modules})


def switched(kind: str, settings: dict[str, Any] | None, **defaults: Any) -> list[dict[str, Any]]:
    """Return the config of a part that a method brings, or nothing if it is switched off (None)."""
    return [] if settings is None else [{"type": kind, **defaults, **settings}]


def weighted(
    parts: Sequence[dict[str, Any]], kind: str, name: str, weight: float | None
) -> list[dict[str, Any]]:
    """Return configs of parts, with another weight in those of one type unless it is None."""
    if weight is None:
        return list(parts)
    return [{**part, name: weight} if part["type"] == kind else part for part in parts]


def check_parts(head: "MapHead") -> set[str]:
    """Return the fields (``pred.<name>``, ``gt.<name>``) that a head's losses and costs read.

    Raises:
        ValueError: If one reads what nobody offers, two losses or query groups have one name, a
            group names a loss or a part a class that there is not.
    """
    names = ["cls", *head.losses]
    _refuse_twins([*names, *head.aux_heads], "losses")
    _refuse_twins([group.name for group in head.query_groups], "query groups")
    for group in head.query_groups:
        unknown = sorted(set(group.losses or ()) - set(names))
        if unknown:
            raise ValueError(
                f"query group {group.name!r} names losses {unknown}; there are {names}."
            )
    costs, losses = head.assigner.match_costs, list(head.losses.values())
    named = {"masks.filled_classes": head.masks.filled_classes}
    for part in [*losses, *costs]:
        if hasattr(part, "renderer"):
            named[f"{type(part).__name__}.polygon_classes"] = part.renderer.polygon_classes
    for name, indices in named.items():
        if any(not 0 <= index < len(head.classes) for index in indices):
            raise ValueError(
                f"{name} must be indices of {list(head.classes)}, got {tuple(indices)}."
            )
    pred = {"scores", "instance_states", *head.reference.fields, *head.decoder.fields}
    offered = {"bev_feats", *(f"pred.{x}" for x in pred), *GT_FIELDS, *MATCHED_GT_FIELDS}
    where = f"{type(head.reference).__name__}, the decoder and the ground truth"
    read = _fields_read(costs, offered - AFTER_MATCHING, f"before the matching, {where}")
    return read | _fields_read(losses, offered, where)


def _refuse_twins(names: Sequence[str], what: str) -> None:
    """Refuse two of one name."""
    twins = sorted({name for name in names if names.count(name) > 1})
    if twins:
        raise ValueError(f"two {what} have one name, {twins[0]!r}; there are {list(names)}.")


def _fields_read(parts: Sequence[Any], offered: Set[str], where: str) -> set[str]:
    """Return the fields that losses or costs read; refuse those that are not offered."""
    reads = {type(part).__name__: set(getattr(part, "reads", ())) for part in parts}
    for name, own in reads.items():
        if own - offered:
            raise ValueError(
                f"{name} reads {sorted(own - offered)}, which {where} do not offer; there are "
                f"{sorted(offered)}."
            )
    return set().union(*reads.values())
