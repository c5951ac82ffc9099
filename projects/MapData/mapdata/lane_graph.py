"""The lane graph of a map: which lines along lanes join to one."""

from collections.abc import Iterable, Iterator, Sequence
from itertools import chain, islice
from typing import Any

import numpy as np
import shapely

from gsmap.utils.errors import InputError

ROUND_DECIMALS = 3  # points closer than a millimetre are one node of the graph
SIMPLIFY_TOLERANCE_M = 0.2
MAX_PATHS = 20_000

# An edge leads to a node by way of one lane's private points: (interior point ids, end point id).
Edge = tuple[tuple[int, ...], int]
# For each lane of a map, its links: positions of a lane and of the one that follows it.
LaneLinks = Sequence[Sequence[tuple[int, int]]]


def link_lanes(lanes: Sequence[tuple[Any, Iterable[Any], Iterable[Any]]]) -> LaneLinks:
    """Say by position which lanes follow one another: those of a map, each with its neighbours.

    A lane is its id, its predecessors' ids and its successors'; ids outside the map are left out.
    """
    position = {lane_id: i for i, (lane_id, _, _) in enumerate(lanes)}
    return [
        [(position[other], i) for other in predecessors if other in position]
        + [(i, position[other]) for other in successors if other in position]
        for i, (_, predecessors, successors) in enumerate(lanes)
    ]


class LanePaths:
    """One polyline per lane of a map, and the simple paths through any subset of them.

    The graph has a node for every polyline point (rounded to 1 mm, so that lanes may share nodes),
    an edge between consecutive points, and an edge from the end of each lane to the start of each
    of its successors. A path runs from a node that nothing leads to, to a node that leads nowhere,
    without visiting a node twice. Points that only one lane has are folded into the edges once per
    map, so that a frame's search takes about one step per lane.

    Args:
        polylines: Points of each lane's line, in metres, map frame, finite. list of (n >= 2, 3)
        links: Which lanes follow which.
    """

    def __init__(self, polylines: Sequence[np.ndarray], links: LaneLinks) -> None:
        for i, line in enumerate(polylines):
            if line.ndim != 2 or line.shape[1] != 3 or len(line) < 2:
                raise InputError(f"polylines[{i}] must have shape (n >= 2, 3), got {line.shape}.")
            if not np.isfinite(line).all():
                raise InputError(f"polylines[{i}] holds NaN or infinity.")
        rounded = np.round(np.concatenate([np.empty((0, 3)), *polylines]), ROUND_DECIMALS)
        self._points, nodes, uses = np.unique(
            rounded, axis=0, return_inverse=True, return_counts=True
        )  # (nodes, 3)
        ends = np.cumsum([len(line) for line in polylines], dtype=np.int64)
        lanes = [lane.tolist() for lane in np.split(nodes, ends)[:-1]]
        self._edges = [_fold(lane, uses) for lane in lanes]
        self._links = [
            [(a, b, (lanes[a][-1], ((), lanes[b][0]))) for a, b in of_lane] for of_lane in links
        ]
        self._memo: tuple[tuple[int, ...], np.ndarray] = ((), np.empty(0, dtype=object))

    def simplified(self, lanes: Sequence[int]) -> np.ndarray:
        """Return every simple path through the given lanes, simplified (Douglas-Peucker, 0.2 m).

        Lanes are positions, in the order of the map. The result are 3-D line strings in the map
        frame, at most ``MAX_PATHS``. The latest is kept: neighbouring frames often see the same.
        """
        key = tuple(lanes)
        if key != self._memo[0]:
            graph = self._subgraph(key)
            entered = {end for edges in graph.values() for _, end in edges}
            sources = (node for node, edges in graph.items() if edges and node not in entered)
            found = chain.from_iterable(_paths_from(source, graph) for source in sources)
            paths = list(islice(found, MAX_PATHS + 1))
            if len(paths) > MAX_PATHS:
                raise InputError(
                    f"the lanes of one frame allow more than {MAX_PATHS} paths: the lane graph is "
                    "damaged."
                )
            nodes = np.array([node for path in paths for node in path], dtype=np.int64)
            indices = np.repeat(np.arange(len(paths)), [len(path) for path in paths])
            lines = shapely.linestrings(self._points[nodes], indices=indices)
            self._memo = (key, shapely.simplify(lines, SIMPLIFY_TOLERANCE_M))
        return self._memo[1]

    def _subgraph(self, lanes: Sequence[int]) -> dict[int, list[Edge]]:
        """Return the edges that leave each node when only ``lanes`` take part, in their order."""
        members = set(lanes)
        graph: dict[int, dict[Edge, None]] = {}  # inner dicts: ordered sets
        for lane in lanes:
            links = (edge for a, b, edge in self._links[lane] if a in members and b in members)
            for start, edge in chain(self._edges[lane], links):
                graph.setdefault(start, {})[edge] = None
                graph.setdefault(edge[1], {})
        return {node: list(edges) for node, edges in graph.items()}


def _fold(nodes: Sequence[int], uses: np.ndarray) -> list[tuple[int, Edge]]:
    """Return a lane's edges between its ends and shared nodes, private points folded in."""
    edges: list[tuple[int, Edge]] = []
    start, interior = nodes[0], []
    for i, node in enumerate(nodes[1:], 1):
        if uses[node] == 1 and i < len(nodes) - 1:
            interior.append(node)
        else:
            edges.append((start, (tuple(interior), node)))
            start, interior = node, []
    return edges


def _paths_from(source: int, graph: dict[int, list[Edge]]) -> Iterator[list[int]]:
    """Yield the nodes of every simple path from ``source`` to a node that leads nowhere."""
    path, visited = [source], {source}
    # (length of the path up to the node, node, edges still to try)
    stack = [(1, source, iter(graph[source]))]
    while stack:
        length, node, edges = stack[-1]
        del path[length:]
        edge = next((e for e in edges if e[1] not in visited), None)
        if edge is None:
            stack.pop()
            visited.discard(node)
            continue
        interior, end = edge
        path += *interior, end
        if graph[end]:
            visited.add(end)
            stack.append((len(path), end, iter(graph[end])))
        else:
            yield path.copy()
