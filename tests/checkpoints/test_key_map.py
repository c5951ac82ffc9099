"""Which table a checkpoint's keys belong to."""

import pytest

from gsmap.checkpoints.key_map import find_key_map, key_maps
from gsmap.checkpoints.key_rules import KeyMap


@pytest.mark.parametrize("key_map", key_maps(), ids=lambda key_map: key_map.name)
@pytest.mark.parametrize("side", [0, 1], ids=["upstream", "ours"])
def test_a_state_with_the_markers_of_a_table_is_read_by_it(key_map: KeyMap, side: int):
    keys = [f"{pair[side].replace('{i}', '0')}weight" for pair in key_map.markers]
    if side == 0:
        keys.append(f"{key_map.upstream_prefix}weight")
    assert find_key_map(keys) is key_map


def test_the_table_without_a_marker_is_the_last():
    markers = [key_map.markers for key_map in key_maps()]
    assert markers.index(KeyMap.markers) == len(markers) - 1
