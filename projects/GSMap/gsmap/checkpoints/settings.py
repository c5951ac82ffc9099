"""The settings that a model was trained with, as they stand in its checkpoint."""

import json
from collections.abc import Mapping
from typing import Any

MODEL_SETTINGS = "model_settings"  # key of a checkpoint's meta: JSON, as a config's text is code


def plain(settings: Any) -> Any:
    """Return settings as JSON knows them: tuples are lists, objects their text."""
    return json.loads(json.dumps(settings, default=str))


def differences(ours: Any, others: Any, name: str = "") -> dict[str, tuple[Any, Any]]:
    """Compare nested dictionaries, lists and plain values.

    Returns both values by dotted name, which begins with ``name``; None is what is not there.
    """
    if isinstance(ours, list) and isinstance(others, list):
        return differences(dict(enumerate(ours)), dict(enumerate(others)), name)
    if not (isinstance(ours, Mapping) and isinstance(others, Mapping)):
        return {} if ours == others else {name: (ours, others)}
    found: dict[str, tuple[Any, Any]] = {}
    for key in dict.fromkeys([*ours, *others]):
        inner = f"{name}.{key}" if name else str(key)
        found |= differences(ours.get(key), others.get(key), inner)
    return found
