"""Which list of scenes stands behind data, models and results: a name with a digest of the list."""

import hashlib
import json
import re
from collections.abc import Collection, Mapping
from typing import Any

from gsmap.utils.errors import InputError

SPLIT_LIST = "split_list"  # key in annotation files, checkpoints and results
TRAINED_ON = "trained_on"  # key in results: the model's list, where it is of the same data set
_FORM = re.compile(r"[\w.+=-]{1,100}(@[0-9a-f]{16})?")


def list_identity(name: str, scenes: Mapping[str, Collection[str]]) -> str:
    """Return ``name@digest`` of a list: scenes by the part of the split, in any order."""
    plain = json.dumps({part: sorted(names) for part, names in scenes.items()}, sort_keys=True)
    return f"{name}@{hashlib.sha256(plain.encode()).hexdigest()[:16]}"


def checked_identity(text: Any) -> str:
    """Return what a file calls its list, nothing where it says nothing; ValueError for others."""
    if text in (None, ""):
        return ""
    if not isinstance(text, str) or not _FORM.fullmatch(text):
        raise InputError(f"{SPLIT_LIST} must be a name with a digest, got {text!r:.60}.")
    return text


def require_same_list(model: Any, data: Any, subject: str, remedy: str) -> None:
    """Refuse data whose places a model may have been trained on, as another split has them.

    Args:
        model: The list that it was trained on; nothing if that is unknown, as in older files.
        data: The list of the data, likewise.
        subject: What was trained, for the message.
        remedy: What allows it.

    Raises:
        ValueError: If both are known and differ.
    """
    first, second = checked_identity(model), checked_identity(data)
    if first and second and first != second:
        raise InputError(
            f"{subject} was trained on the split {first}, and the data to score is of {second}, "
            "whose places may be among those of the training: take data of the same split, or "
            f"allow it with {remedy}."
        )


def require_results_of(split_list: str, about: Mapping[str, Any], path: object) -> None:
    """Refuse results of a model of another list than that of the data to score.

    Args:
        split_list: The list of the data; nothing if it is unknown.
        about: What the result file says of itself.
        path: The result file, for the message.

    Raises:
        ValueError: If both are known and differ.
    """
    for name in (TRAINED_ON, SPLIT_LIST):
        subject = f"the model of {path}"
        require_same_list(about.get(name), split_list, subject, "--allow-other-split")
