"""Groups of instance queries. Each group is matched to the ground truth separately."""

from dataclasses import dataclass

from gsmap.utils.errors import InputError


@dataclass(frozen=True)
class QueryGroup:
    """Settings of a group of instance queries, which is matched to the ground truth separately.

    Queries of different groups do not attend to each other.

    Args:
        num: Number of instance queries, >= 1.
        name: Suffix of the group in the names of its losses. It is empty for the group whose
            queries give the predictions of the model.
        repeats: Number of queries that each ground truth is matched to, >= 1.
        weight: Factor of the losses of the group.
        losses: Names of the losses of the head that are computed for the group. None means all of
            them.

    Raises:
        ValueError: If ``num`` or ``repeats`` is not positive.
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
