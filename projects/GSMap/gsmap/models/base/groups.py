"""Groups of instance queries that are matched together."""

from dataclasses import dataclass

from gsmap.utils.errors import InputError


@dataclass(frozen=True)
class QueryGroup:
    """Instance queries that are matched together; no group attends to another.

    Args:
        num: Instance queries.
        name: Suffix of its losses; empty for the group that predicts.
        repeats: How often each ground truth may be matched.
        weight: Weight of its losses.
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
            raise InputError(
                f"a query group needs num >= 1 and repeats >= 1, got {self.num} and {self.repeats}."
            )
