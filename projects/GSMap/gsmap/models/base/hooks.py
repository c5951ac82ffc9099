"""Hooks into the flow of a head, the sequence of steps from the initial queries to the losses.

Hooks add queries from previous frames (temporal memory) or queries with known matches (denoising).
"""

from collections.abc import Sequence
from typing import NamedTuple, Protocol

from torch import Tensor, nn

from gsmap.models.base.decoder import Queries
from gsmap.models.base.groups import QueryGroup
from gsmap.models.base.pairs import BuiltHead, GroundTruth, MatchedPairs, Predictions


class FlowStart(NamedTuple):
    """Input of the first decoder layer: N instances with P points each.

    Attributes:
        queries: States, positions and references (reference points) for `MapDecoder.forward`.
            States and positions are (B, N * P, C) for a decoder of point queries, and (B, N, C) for
            a decoder of instance queries. References are (B, N * P, D), with D numbers per point.
        mask: True where an instance (row) may not attend to another instance (column); None if
            nothing is masked. (N, N)
    """

    queries: Queries
    mask: Tensor | None


class FlowHead(BuiltHead, Protocol):
    """Interface of a head to its hooks.

    Attributes:
        embed_dims: Channels C of the queries.
        num_points: Points P of an instance.
        query_groups: Groups of instance queries, which are matched separately. The first group
            gives the predictions of the model.
        cls_branches: Classification branch of each decoder layer.
    """

    embed_dims: int
    num_points: int
    query_groups: list[QueryGroup]
    cls_branches: nn.ModuleList

    def known_losses(
        self,
        group: QueryGroup,
        layers: Sequence[Predictions],
        truths: GroundTruth,
        matches: Sequence[tuple[Tensor, Tensor]],
    ) -> dict[str, Tensor]:
        """Compute the losses of queries with known matches (`MapHead.known_losses`).

        Args:
            group: Name, weight and losses of the queries.
            layers: Predictions of the queries, after each layer.
            truths: Ground truth of the batch.
            matches: Matched pairs of each sample, as increasing indices of the queries and indices
                of the ground truths, on the CPU. (m,) each
        """
        ...


class FlowHook:
    """Base class of hooks into the flow of a head for one batch.

    The methods of the base class change nothing. Hooks are called in their order, except for
    `outputs`: there the order is reversed, so that each hook removes the queries that it has
    appended.
    """

    def start(self, head: FlowHead, start: FlowStart) -> FlowStart:
        """Return the input of the first decoder layer: ``start``, with any new queries appended.

        Args:
            head: The head.
            start: Queries of the head and of the previous hooks.
        """
        return start

    def refine(self, head: FlowHead, layer: int, refined: Tensor) -> Tensor:
        """Return the references after a layer.

        Args:
            head: The head.
            layer: Index of the layer.
            refined: References after this layer, as the head and the previous hooks have refined
                them. (B, N * P, D)
        """
        return refined

    def between(self, head: FlowHead, layer: int, queries: Queries) -> Queries:
        """Return the queries of the next layer. The method is also called after the last layer.

        Args:
            head: The head.
            layer: Index of the previous layer.
            queries: Queries after the previous layer.
        """
        return queries

    def outputs(self, head: FlowHead, layers: list[Predictions]) -> list[Predictions]:
        """Return the predictions of the head without the queries that the hook has appended.

        Args:
            head: The head.
            layers: Predictions of each layer.
        """
        return layers

    def targets(self, head: FlowHead, pairs: MatchedPairs) -> None:
        """Receive the matches of the first query group in the last layer.

        The method is called before `losses`.

        Args:
            head: The head.
            pairs: Matched pairs of predictions and ground truths.
        """

    def losses(self, head: FlowHead, truths: GroundTruth) -> dict[str, Tensor]:
        """Return further losses by name. The names contain ``loss``.

        Args:
            head: The head.
            truths: Ground truth of the batch.
        """
        return {}


class FlowPart(Protocol):
    """Interface of modules of a head that make a `FlowHook` for each training batch.

    The head builds the module from its settings, and adds ``embed_dims`` and ``num_classes`` to
    them. The module is not used in prediction.

    Attributes:
        name: Name of the module, unique in a head.
    """

    name: str

    def hook(self, head: FlowHead, truths: GroundTruth) -> FlowHook:
        """Create the hook of a training batch.

        Args:
            head: The head.
            truths: Ground truth of the batch.
        """
        ...
