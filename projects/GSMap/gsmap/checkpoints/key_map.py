"""The tables between the state keys of releases and ours, of all methods."""

from collections import Counter
from collections.abc import Iterable
from functools import cache
from importlib import import_module
from importlib.util import find_spec

from gsmap.checkpoints.key_rules import KeyMap
from gsmap.methods import METHODS
from gsmap.utils.errors import InputError


@cache
def key_maps() -> tuple[KeyMap, ...]:
    """Return the tables of all methods, the most special first; the last are known by no marker.

    Each is in ``KEY_MAPS`` of ``gsmap/models/<method>/keys.py``, which a method without a release
    of its own has not.
    """
    found: tuple[KeyMap, ...] = ()
    users = Counter(name for method in METHODS for name in method.built_on)
    # what others are built on comes after them; of the others a later one is more special
    for method in sorted(reversed(METHODS), key=lambda method: users[method.name]):
        name = f"gsmap.models.{method.name}.keys"
        if find_spec(name) is not None:
            found += import_module(name).KEY_MAPS
    return tuple(sorted(found, key=lambda key_map: key_map.markers == KeyMap.markers))


def is_upstream(keys: Iterable[str]) -> bool:
    """Return whether state keys are in the format of the earlier systems."""
    signs = tuple({key_map.sign for key_map in key_maps()})
    return any(key.startswith(signs) for key in keys)


def find_key_map(keys: Iterable[str]) -> KeyMap:
    """Return the map of the architecture that state keys, upstream's or ours, belong to."""
    keys = list(keys)
    upstream = is_upstream(keys)
    for key_map in key_maps():
        if key_map.is_marked(keys, upstream):
            return key_map
    raise InputError("the checkpoint holds no weights.")
