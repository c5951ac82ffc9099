"""Groups of instance queries. Each group is matched to the ground truth separately."""

from dataclasses import dataclass

from torch import Tensor

from gsmap.utils.errors import InputError


@dataclass(frozen=True)
class QueryGroup:
    """Settings of a group of instance queries, which is matched to the ground truth separately.

    The head gives the decoder a mask by which queries of different groups do not attend to each
    other. A decoder may leave it out of some of its attentions (`MapDecoder.layer_mask`).

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


def without_groups(mask: Tensor | None, group_mask: Tensor | None) -> Tensor | None:
    """Remove the mask between query groups from an attention mask of a head and its hooks.

    What hooks have blocked for the queries that they have appended stays blocked.

    Args:
        mask: True where an instance (row) may not attend to another (column), or None. The
            instances of the query groups come first. (N, N)
        group_mask: True between instances of different groups; None for a single group. It is
            ``mask`` itself if no hook has changed the mask.

    Returns:
        The mask without the blocks between groups; None if nothing was added to them.
    """
    if group_mask is None:
        return mask
    if mask is None or mask is group_mask:
        return None
    num_instances = len(group_mask)
    remaining = mask.clone()
    remaining[:num_instances, :num_instances] &= ~group_mask
    return remaining
