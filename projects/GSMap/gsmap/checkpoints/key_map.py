"""Key maps of all map models: their state keys in the authors' code and in this project.

State keys are the names of weights in a checkpoint (``state_dict``).
"""

from collections import Counter
from collections.abc import Iterable
from functools import cache
from importlib import import_module
from importlib.util import find_spec

from gsmap.checkpoints.key_rules import KeyMap
from gsmap.methods import METHODS
from gsmap.utils.errors import InputError


@cache  # the modules of all models are imported once
def key_maps() -> tuple[KeyMap, ...]:
    """Key maps of all map models in `METHODS`, the most special first; maps without markers last.

    A marker is a prefix of a key by which a model is recognised. A map without markers has the
    empty prefix as its default marker, which every key has. A special model builds on others, and
    its checkpoints contain their markers, too. It must therefore be tried before them. The maps of
    a model are in ``KEY_MAPS`` of ``gsmap/models/<method>/keys.py``. A model without such a file
    has no published checkpoints.
    """
    num_users: Counter[str] = Counter()  # number of models that build on each model
    for method in METHODS:
        num_users.update(method.built_on)
    # `built_on` names all models that a model builds on, also indirectly. If A builds on B, each
    # model that builds on A is therefore counted for B, too, and so is A. So A has the smaller
    # number and comes first. At equal numbers, the model that is later in METHODS comes first,
    # because it is more special.
    methods = sorted(reversed(METHODS), key=lambda method: num_users[method.name])
    maps: list[KeyMap] = []
    for method in methods:
        module = f"gsmap.models.{method.name}.keys"
        if find_spec(module) is not None:
            maps += import_module(module).KEY_MAPS
    # False sorts before True, so maps without markers come last. The sort is stable: within both
    # groups, the order of the models is kept.
    return tuple(sorted(maps, key=_has_default_markers))


def _has_default_markers(key_map: KeyMap) -> bool:
    """Whether a key map has no markers and so matches the keys of every model."""
    # The default is one marker with empty prefixes. The attribute of the class is the default value
    # of the field.
    return key_map.markers == KeyMap.markers


def is_upstream(keys: Iterable[str]) -> bool:
    """Whether state keys have the format of upstream, the code of the models' authors."""
    prefixes = tuple({key_map.upstream_prefix for key_map in key_maps()})
    return any(key.startswith(prefixes) for key in keys)


def find_key_map(keys: Iterable[str]) -> KeyMap:
    """Find the key map of the architecture of a state.

    Args:
        keys: State keys, of upstream or of this project.

    Returns:
        The first of `key_maps` whose markers are all present.

    Raises:
        ValueError: If there are no keys.
    """
    keys = list(keys)
    upstream = is_upstream(keys)
    for key_map in key_maps():
        if key_map.is_marked(keys, upstream=upstream):
            return key_map
    # The last maps have only the empty prefix as a marker. It is a prefix of any key, so there are
    # no keys.
    raise InputError("the checkpoint holds no weights.")
