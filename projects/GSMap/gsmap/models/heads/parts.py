"""What a head checks of its parts when it is built: names, classes, the fields that each reads."""

from collections.abc import Iterable, Sequence, Set
from typing import Any

from torch import nn

from gsmap.models.heads.masks import ElementMasks
from gsmap.models.heads.query_groups import QueryGroup


def by_name(modules: Sequence[nn.Module]) -> dict[str, nn.Module]:
    """Return modules by their ``name``.

    Raises:
        ValueError: If two have the same.
    """
    refuse_twins([str(module.name) for module in modules], "parts")
    return {str(module.name): module for module in modules}


def refuse_twins(names: Sequence[str], what: str) -> None:
    """Refuse two of one name.

    Raises:
        ValueError: If there are.
    """
    twins = sorted({name for name in names if names.count(name) > 1})
    if twins:
        raise ValueError(f"two {what} have one name, {twins[0]!r}; there are {list(names)}.")


def fields_read(parts: Iterable[Any], offered: Set[str], where: str) -> set[str]:
    """Return the fields (``pred.<name>``, ``gt.<name>``) that losses or costs read.

    Args:
        parts: Losses or costs; each names its fields in ``reads``.
        offered: What there is to read.
        where: Who offers it, for the message.

    Raises:
        ValueError: If a part reads what nobody offers.
    """
    read: set[str] = set()
    for part in parts:
        own = set(getattr(part, "reads", ()))
        missing = sorted(own - offered)
        if missing:
            raise ValueError(
                f"{type(part).__name__} reads {missing}, which {where} do not offer; there are "
                f"{sorted(offered)}."
            )
        read |= own
    return read


def refuse_unknown_losses(groups: Sequence[QueryGroup], losses: Sequence[str]) -> None:
    """Refuse a query group that names a loss which is not there.

    Raises:
        ValueError: If one does.
    """
    for group in groups:
        unknown = sorted(set(group.losses or ()) - set(losses))
        if unknown:
            raise ValueError(
                f"query group {group.name!r} names losses {unknown}; there are {list(losses)}."
            )


def refuse_unknown_classes(
    masks: ElementMasks, parts: Iterable[Any], classes: Sequence[str]
) -> None:
    """Refuse masks, losses and costs that fill or render as polygons what is no class.

    Raises:
        ValueError: If an index is beyond the classes.
    """
    named = {"masks.filled_classes": masks.filled_classes}
    for part in parts:
        if hasattr(part, "renderer"):
            named[f"{type(part).__name__}.polygon_classes"] = part.renderer.polygon_classes
    for name, indices in named.items():
        if any(not 0 <= index < len(classes) for index in indices):
            raise ValueError(f"{name} must be indices of {list(classes)}, got {tuple(indices)}.")
