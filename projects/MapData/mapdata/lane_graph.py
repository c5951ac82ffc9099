"""Lane graph of a map, and the paths along lanes that are drawn as one line."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import shapely

from gsmap.utils.errors import InputError

ROUND_DECIMALS = 3  # points that are equal after rounding to millimetres are one node of the graph
SIMPLIFY_TOLERANCE_M = 0.2
MAX_PATHS = 20_000  # more paths in one frame mean that the map is damaged

# Edge of the graph, without its start: indices of the points on the way, and index of the point at
# which it ends.
Edge = tuple[tuple[int, ...], int]
# For each lane of a map, the list of its links. A link is a pair of positions in the list of lanes:
# the second lane follows the first one, and the lane is one of the two.
LaneLinks = Sequence[Sequence[tuple[int, int]]]


def link_lanes(lanes: Sequence[tuple[Any, Iterable[Any], Iterable[Any]]]) -> LaneLinks:
    """Find the links between the lanes of a map by their positions.

    Args:
        lanes: Id, ids of the predecessors, and ids of the successors of each lane. Ids that are not
            in the map are ignored.

    Returns:
        For each lane its links: positions of a lane and of a lane that follows it.
    """
    position = {lane_id: i for i, (lane_id, _, _) in enumerate(lanes)}
    links = []
    for i, (_, predecessors, successors) in enumerate(lanes):
        lane_links = []
        for other in predecessors:
            if other in position:
                lane_links.append((position[other], i))
        for other in successors:
            if other in position:
                lane_links.append((i, position[other]))
        links.append(lane_links)
    return links


class LanePaths:
    """Polylines of the lanes of a map, and the simple paths through subsets of the lanes.

    The graph has a node for every polyline point (rounded to 1 mm, so that lanes may share nodes),
    an edge between consecutive points, and an edge from the end of each lane to the start of each
    of its successors. A path is simple: it visits no node twice. It runs from a node without
    incoming edges to a node without outgoing edges. Points that belong to one lane only are folded
    into the edges once per map, so that the search in a frame takes about one step per lane.

    A subset of lanes is usually the lanes near the vehicle in one frame of a drive.

    Args:
        polylines: Points of each lane in the map frame, in metres, finite. (n >= 2, 3) each
        links: Links of each lane, as `link_lanes` finds them.

    Raises:
        ValueError: If a polyline has another shape, or is not finite.
    """

    def __init__(self, polylines: Sequence[np.ndarray], links: LaneLinks) -> None:
        for i, line in enumerate(polylines):
            if line.ndim != 2 or line.shape[1] != 3 or len(line) < 2:
                raise InputError(f"polylines[{i}] must have shape (n >= 2, 3), got {line.shape}.")
            if not np.isfinite(line).all():
                raise InputError(f"polylines[{i}] holds NaN or infinity.")
        # The empty array allows a map without lanes.
        rounded = np.round(np.concatenate([np.empty((0, 3)), *polylines]), decimals=ROUND_DECIMALS)
        # Vertices at one place become one point. `nodes` is the index of the point of each vertex,
        # and `uses` the number of vertices of each point.
        self._points, nodes, uses = np.unique(
            rounded, axis=0, return_inverse=True, return_counts=True
        )  # (nodes, 3)
        # A lane is the list of the indices of its points. `split` also returns an empty part after
        # the last lane, which is dropped.
        ends = np.cumsum(list(map(len, polylines)), dtype=np.int64)
        lanes = [lane.tolist() for lane in np.split(nodes, ends)[:-1]]
        self._edges = [_fold_points(lane, uses=uses) for lane in lanes]
        # Each lane has a list of links. A link consists of two lanes that follow each other, and
        # the edge from the end of the first one to the start of the second one, with its start
        # point.
        self._links: list[list[tuple[int, int, tuple[int, Edge]]]] = []
        for lane_links in links:
            link_edges: list[tuple[int, int, tuple[int, Edge]]] = []
            for before, after in lane_links:
                end = lanes[before][-1]
                start = lanes[after][0]
                edge: Edge = ((), start)  # without points on the way
                link_edges.append((before, after, (end, edge)))
            self._links.append(link_edges)
        self._last_key: tuple[int, ...] = ()
        self._last_lines = np.empty(0, dtype=object)

    def simplify_paths(self, lanes: Sequence[int]) -> np.ndarray:
        """Find all simple paths through some lanes, simplified (Douglas-Peucker, 0.2 m).

        The last result is cached, as neighbouring frames often contain equal lanes.

        Args:
            lanes: Positions of the lanes, in the order of the map.

        Returns:
            3-D line strings in the map frame, at most ``MAX_PATHS``. (paths,)

        Raises:
            ValueError: If there are more than ``MAX_PATHS`` paths.
        """
        key = tuple(lanes)
        if key == self._last_key:
            return self._last_lines  # at first, no lines for no lanes
        graph = self._subgraph(key)
        targets: set[int] = set()  # nodes with an incoming edge
        for edges in graph.values():
            for _, end in edges:
                targets.add(end)
        paths: list[list[int]] = []
        for node, edges in graph.items():
            if not edges or node in targets:
                continue  # no path starts at a node without outgoing or with incoming edges
            for path in _paths_from(node, graph):
                paths.append(path)
                if len(paths) > MAX_PATHS:
                    raise InputError(
                        f"the lanes of one frame allow more than {MAX_PATHS} paths: the lane graph "
                        "is damaged."
                    )
        # All lines are created in one call, from the nodes of all paths and the path of each node.
        nodes: list[int] = []
        path_of_node: list[int] = []
        for path_index, path in enumerate(paths):
            nodes += path
            path_of_node += [path_index] * len(path)
        points = self._points[np.array(nodes, dtype=np.int64)]
        lines = shapely.linestrings(points, indices=np.array(path_of_node, dtype=np.int64))
        self._last_key = key
        self._last_lines = shapely.simplify(lines, tolerance=SIMPLIFY_TOLERANCE_M)
        return self._last_lines

    def _subgraph(self, lanes: Sequence[int]) -> dict[int, list[Edge]]:
        """Edges that leave each node in the graph of some lanes, in the order of the lanes.

        The order of the edges determines the order of the paths.
        """
        members = set(lanes)
        # The inner dictionaries are used as ordered sets: an edge of two lanes is in it once.
        graph: dict[int, dict[Edge, None]] = {}
        for lane in lanes:
            edges = list(self._edges[lane])
            for before, after, link in self._links[lane]:
                if before in members and after in members:
                    edges.append(link)
            for start, edge in edges:
                _, end = edge
                graph.setdefault(start, {})[edge] = None
                graph.setdefault(end, {})  # the end may have no edges
        return {node: list(edges_of_node) for node, edges_of_node in graph.items()}


def _fold_points(nodes: Sequence[int], uses: np.ndarray) -> list[tuple[int, Edge]]:
    """Edges of a lane between its ends and the nodes that it shares with other lanes.

    The other points are on the way of the edges. A point that a lane visits twice is a node, too.

    Args:
        nodes: Points of the lane, as indices.
        uses: Number of vertices at each point of the map. (nodes,)

    Returns:
        Start node of each edge, and the edge, in the direction of the lane.
    """
    edges: list[tuple[int, Edge]] = []
    start = nodes[0]
    interior: list[int] = []
    for node in nodes[1:-1]:
        if uses[node] == 1:
            interior.append(node)
        else:
            edges.append((start, (tuple(interior), node)))
            start = node
            interior = []
    edges.append((start, (tuple(interior), nodes[-1])))
    return edges


def _next_edge(edges: Iterator[Edge], visited: set[int]) -> Edge | None:
    """Return the next edge of an iterator that ends at an unvisited node; None if there is none.

    The iterator keeps its position, so the next call continues after this edge.
    """
    for edge in edges:
        _, end = edge
        if end not in visited:
            return edge
    return None


def _paths_from(source: int, graph: dict[int, list[Edge]]) -> Iterator[list[int]]:
    """Yield the nodes of every simple path from a node to a node without outgoing edges.

    This is a depth-first search with an explicit stack, as recursion has a limited depth.
    """
    path = [source]
    visited = {source}
    # (length of the path up to the node, node, edges still to try)
    stack = [(1, source, iter(graph[source]))]
    while stack:
        length, node, edges = stack[-1]
        del path[length:]  # go back to the node
        edge = _next_edge(edges, visited)
        if edge is None:  # all edges of the node have been tried
            stack.pop()
            visited.discard(node)
            continue
        interior, end = edge
        path += interior
        path.append(end)
        if graph[end]:
            visited.add(end)
            stack.append((len(path), end, iter(graph[end])))
        else:
            yield path.copy()
