"""Parts of map elements in the range of a frame."""

from collections.abc import Sequence

from gsmap.structures.classes import AREA_CLASSES
from gsmap.structures.elements import FloatArray, MapElements
from gsmap.structures.polylines import clip_to_box

_FEWEST_OF_RING = 4  # vertices of a closed triangle, whose last vertex is its first one


def cut_to_range(
    elements: MapElements,
    classes: Sequence[str],
    x_range: tuple[float, float],
    y_range: tuple[float, float],
) -> MapElements:
    """Cut elements to the range of a frame, by the rules for ground truth.

    An area is replaced by the outlines of its parts in the range, and a line by its parts in the
    range.

    Args:
        elements: Elements in the frame, (x, y) in metres.
        classes: Class names in label order.
        x_range: Smallest and largest x of the range in metres.
        y_range: Smallest and largest y of the range in metres.

    Returns:
        Parts of the elements in the order of the elements. A part has the score of its element, or
        1 if the elements have no scores. Parts of areas have no z.
    """
    import shapely  # imported here: most programs that use elements cut none

    box = shapely.box(x_range[0], y_range[0], x_range[1], y_range[1])
    parts: list[FloatArray] = []
    labels: list[int] = []
    scores: list[float] = []
    for line, label, score in elements.rows:
        if classes[label] in AREA_CLASSES and len(line) >= _FEWEST_OF_RING:
            polygon = shapely.make_valid(shapely.Polygon(line))  # the outline may cross itself
            area_in_range = polygon & box
            pieces = []
            for area in shapely.get_parts(area_in_range):
                if area.area > 0.0:  # parts may also be points or lines
                    # As in ground truth, an area has an outline and no holes.
                    pieces.append(shapely.get_coordinates(area.exterior))
        else:
            pieces = clip_to_box(line, x_range, y_range)  # vertices of each part
        parts += pieces
        labels += [label] * len(pieces)
        scores += [score] * len(pieces)
    return MapElements.from_polylines(parts, labels=labels, scores=scores)
