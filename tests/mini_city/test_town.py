from itertools import combinations

import numpy as np
import pytest
import shapely
from shapely.geometry import LineString, Polygon

from minicity.curves import arc_lengths
from minicity.map_expansion import town_to_map
from minicity.network import mouth_distances
from minicity.paint import divider_pieces, lane_divider_offsets
from minicity.roads import CrossSection
from minicity.town import Town, make_town, road_surface


@pytest.fixture(scope="module", params=range(4))
def town(request: pytest.FixtureRequest) -> Town:
    return make_town("boston-seaport", request.param, 6)


def test_every_polygon_of_the_map_is_valid(town: Town) -> None:
    content = town_to_map(town, 0)
    nodes = {node["token"]: (node["x"], node["y"]) for node in content["node"]}
    for record in content["polygon"]:
        exterior = [nodes[token] for token in record["exterior_node_tokens"]]
        holes = []
        for hole in record["holes"]:
            holes.append([nodes[token] for token in hole["node_tokens"]])
        polygon = Polygon(exterior, holes)
        assert polygon.is_valid, shapely.is_valid_reason(polygon)
        assert polygon.area > 0.1
    xy = np.array(list(nodes.values()))
    assert xy.min() > 0
    assert xy.max() < town.size_m


def road_surfaces(town: Town) -> list[Polygon]:
    """Polygons of all roads, without junctions."""
    surfaces = []
    for road in town.roads:
        surfaces += road_surface(road)
    return surfaces


def test_roads_and_junctions_meet_without_gap_or_overlap(town: Town) -> None:
    surfaces = road_surfaces(town)
    for junction in town.junctions:
        surfaces.append(Polygon(junction.outline))
    rounded = shapely.set_precision(surfaces, 1e-4)
    union = shapely.union_all(rounded)
    total = shapely.area(rounded).sum()
    assert union.area == pytest.approx(total, rel=1e-5)
    assert union.geom_type == "Polygon", "the streets form one network"
    # A sliver would be a boundary element that nobody can see.
    assert min(Polygon(hole).area for hole in union.interiors) > 20


def test_dividers_lie_on_the_road_between_two_lanes(town: Town) -> None:
    for road in town.roads:
        surface = shapely.union_all(road_surface(road)).buffer(0.01)
        for offset in lane_divider_offsets(road):
            for start, end in divider_pieces(road):
                line = LineString(road.line(offset, start, end))
                assert surface.contains(line)
                assert line.length == pytest.approx(end - start, rel=0.4)


def test_dividers_stop_at_crossings_and_stop_lines(town: Town) -> None:
    for road in town.roads:
        blocked = [*road.crossings, road.stop_forward, road.stop_backward]
        for start, end in divider_pieces(road):
            for area in blocked:
                if area:
                    assert end <= area[0] + 1e-9 or start >= area[1] - 1e-9


def test_connectors_lead_from_the_end_of_a_lane_to_the_head_of_another(town: Town) -> None:
    for key, connectors in town.connectors.items():
        for connector in connectors:
            assert connector.source.key == key
            assert connector.source.end_node == connector.target.start_node
            np.testing.assert_allclose(connector.center[0], connector.source.center[-1])
            np.testing.assert_allclose(connector.center[-1], connector.target.center[0])


def test_houses_and_car_parks_keep_off_the_streets(town: Town) -> None:
    streets = shapely.union_all(road_surfaces(town))
    for building in town.buildings:
        assert not Polygon(building.footprint).intersects(streets)
    for park in town.carparks:
        assert not Polygon(park.outline).intersects(streets)
        assert Polygon(park.driveway).intersects(streets), "cars can get in"
    near = shapely.STRtree([Polygon(building.footprint) for building in town.buildings])
    left, right = near.query(near.geometries, predicate="intersects")
    assert (left == right).all(), "houses overlap"


def test_towns_differ_by_name_and_by_seed() -> None:
    towns = [make_town("a", 0, 4), make_town("b", 0, 4), make_town("a", 1, 4)]
    for first, second in combinations(towns, 2):
        assert not np.allclose(first.roads[0].center[:5], second.roads[0].center[:5], atol=1.0)


def test_a_town_depends_on_its_arguments_alone() -> None:
    first = make_town("a", 3, 4)
    second = make_town("a", 3, 4)
    for one, two in zip(first.roads, second.roads, strict=True):
        np.testing.assert_array_equal(one.center, two.center)
    np.testing.assert_array_equal(first.trees, second.trees)


def test_towns_have_every_kind_of_road() -> None:
    towns = [make_town("a", seed, 20) for seed in range(3)]
    sections = []
    num_arms = set()
    carparks = []
    for town in towns:
        sections += [road.section for road in town.roads]
        num_arms.update(len(junction.arms) for junction in town.junctions)
        carparks += town.carparks
    assert {section.forward for section in sections} == {1, 2, 3}
    assert any(section.backward == 0 for section in sections)
    assert any(section.median_m > 0 for section in sections)
    assert num_arms == {3, 4}
    bends = []
    for road in towns[0].roads:
        bends.append(abs(road.direction(1.0) - road.direction(road.length_m - 1.0)))
    assert max(bends) > 1.0, "some streets turn a corner"
    assert carparks


def test_cross_section_offsets_worked_by_hand() -> None:
    """Two forward lanes of 3 m right of a 2 m median, one backward lane on the left.

    ::

        left   1.5 | 3 |= 2 =| 3 | 3 | 0.5   right
              5.5  4   1    -1  -4  -7  -7.5
    """
    section = CrossSection(2, 1, 3.0, 2.0, 0.5, 1.5)
    assert section.forward_edges == [-1.0, -4.0, -7.0]
    assert section.backward_edges == [1.0, 4.0]
    assert section.all_offsets == [-7.5, -7.0, -4.0, -1.0, 1.0, 4.0, 5.5]


def test_mouth_distance_of_two_roads_at_right_angles() -> None:
    # Kerbs 4 m and 5 m off their centre lines meet 5 m along the first road, 4 m along the second.
    arms = [(0.0, 4.0, 4.0), (np.pi / 2, 5.0, 5.0), (np.pi, 4.0, 4.0)]
    assert mouth_distances(arms, 6.0) == pytest.approx([11.0, 10.0, 11.0])


def test_lanes_are_as_long_as_their_road(town: Town) -> None:
    for lane in town.lanes.values():
        road = town.roads[lane.road]
        assert arc_lengths(lane.center)[-1] == pytest.approx(road.length_m, rel=0.4)
