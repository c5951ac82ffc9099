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
    parts = [
        dict(enumerate(side)) if isinstance(side, list) else side
        for side in (ours, others)
        if isinstance(side, list | Mapping)
    ]
    if len(parts) < 2 or isinstance(ours, list) != isinstance(others, list):
        return {} if ours == others else {name: (ours, others)}
    found: dict[str, tuple[Any, Any]] = {}
    for key in dict.fromkeys([*parts[0], *parts[1]]):
        inner = f"{name}.{key}" if name else str(key)
        found |= differences(parts[0].get(key), parts[1].get(key), inner)
    return found
