"""Hooks into the flow of a head: memory, queries made of the ground truth, known matches, masks."""

from collections.abc import Sequence
from typing import NamedTuple, Protocol

from torch import Tensor, nn

from gsmap.models.base.decoder import Queries
from gsmap.models.base.groups import QueryGroup
from gsmap.models.base.pairs import BuiltHead, GroundTruth, MatchedPairs, Predictions


class FlowStart(NamedTuple):
    """Input of the first decoder layer.

    Attributes:
        queries: States, positions and references of all instance queries N, as
            `MapDecoder.forward` takes them: (B, N * P, ...) for a decoder of point queries.
        mask: True where an instance (row) may not attend to another (column), or None. (N, N)
    """

    queries: Queries
    mask: Tensor | None


class FlowHead(BuiltHead, Protocol):
    """Interface of a head to the hooks that take part in its flow."""

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
        """Return the losses of queries whose matches are known, see `MapHead`."""
        ...


class FlowHook:
    """Base class of hooks into the flow of a head for one batch; its own methods do nothing.

    Hooks are called in their order, `outputs` in the reverse order, so that each one removes the
    queries that it has appended.
    """

    def start(self, head: FlowHead, start: FlowStart) -> FlowStart:
        """Return the input of the first decoder layer; further queries are appended.

        Args:
            head: The head.
            start: The queries of the head and of the hooks before.
        """
        return start

    def refine(self, head: FlowHead, layer: int, refined: Tensor) -> Tensor:
        """Return the references after a layer.

        Args:
            head: The head.
            layer: Number of the layer.
            refined: References that the head has refined. (B, N * P, D)
        """
        return refined

    def between(self, head: FlowHead, layer: int, queries: Queries) -> Queries:
        """Return the queries of the next layer.

        Args:
            head: The head.
            layer: Number of the layer that has just run, the last one included.
            queries: Queries after it.
        """
        return queries

    def outputs(self, head: FlowHead, layers: list[Predictions]) -> list[Predictions]:
        """Return the predictions of the head, without queries that the hook has appended.

        Args:
            head: The head.
            layers: Predictions of each layer.
        """
        return layers

    def targets(self, head: FlowHead, pairs: MatchedPairs) -> None:
        """Read the matches of the predicting queries in the last layer.

        Args:
            head: The head.
            pairs: The pairs of the last layer.
        """

    def losses(self, head: FlowHead, truths: GroundTruth) -> dict[str, Tensor]:
        """Return further losses by name, in which ``loss`` occurs.

        Args:
            head: The head.
            truths: The ground truth of the batch.
        """
        return {}


class FlowPart(Protocol):
    """A part of a head, a module with a ``name``, that gives training batches a `FlowHook`.

    It is built with ``embed_dims`` and ``num_classes`` beside its settings. Prediction does not
    call it.
    """

    name: str

    def hook(self, head: FlowHead, truths: GroundTruth) -> FlowHook:
        """Return the hook of a training batch.

        Args:
            head: The head.
            truths: The ground truth of the batch.
        """
        ...
