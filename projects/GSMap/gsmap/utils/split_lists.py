"""Identity of the list of scenes in each split: a name and a digest.

Data, models and results contain the identity, so that a model is not tested on scenes of its
training by mistake.
"""

import hashlib
import json
import re
from collections.abc import Collection, Mapping
from typing import Any

from gsmap.utils.errors import InputError

SPLIT_LIST = "split_list"  # key in annotation files, checkpoints and results
# Key in results: identity of the list by which the training data of the model were split. It is
# only written if the model was trained on the data set that it was tested on, such as nuScenes.
TRAINED_ON = "trained_on"
# A name, and a digest of 16 hexadecimal digits. Identities without a digest are accepted.
_IDENTITY = re.compile(r"[\w.+=-]{1,100}(@[0-9a-f]{16})?")


def list_identity(name: str, scenes: Mapping[str, Collection[str]]) -> str:
    """Return the identity of a scene list, ``name@digest``.

    Args:
        name: Name of the list.
        scenes: Names of the scenes in each part of the split, in any order.
    """
    # The digest depends on the scenes of each part, but not on any order.
    sorted_scenes = {part: sorted(names) for part, names in scenes.items()}
    text = json.dumps(sorted_scenes, sort_keys=True)
    digest = hashlib.sha256(text.encode()).hexdigest()
    return f"{name}@{digest[:16]}"


def checked_identity(text: Any) -> str:
    """Validate the identity of a scene list from a file.

    Args:
        text: Value from the file; None or empty if the list is unknown.

    Returns:
        The identity, empty if the list is unknown.

    Raises:
        ValueError: If the value is not a name with an optional digest.
    """
    if text in (None, ""):
        return ""
    if not isinstance(text, str) or not _IDENTITY.fullmatch(text):
        raise InputError(f"{SPLIT_LIST} must be a name with a digest, got {text!r:.60}.")
    return text


def require_same_list(model: Any, data: Any, subject: str, remedy: str) -> None:
    """Raise an error if a model was trained on another split than the evaluation data belong to.

    Evaluation data of another split may be from places on which the model was trained.

    Args:
        model: Identity of the training list; None or empty if unknown, as in older files.
        data: Identity of the list of the evaluation data; None or empty if unknown.
        subject: Description of the trained model, for the message.
        remedy: Option that allows another split, for the message.

    Raises:
        ValueError: If both lists are known and differ, or if an identity is malformed.
    """
    model_identity = checked_identity(model)
    data_identity = checked_identity(data)
    if model_identity and data_identity and model_identity != data_identity:
        raise InputError(
            f"{subject} was trained on the split {model_identity}, and the data to score belongs "
            f"to {data_identity}, whose places may be among those of the training: take data of "
            f"the same split, or allow it with {remedy}."
        )


def require_results_of(split_list: str, about: Mapping[str, Any], path: object) -> None:
    """Raise an error if results do not belong to the split of the evaluation data.

    This is the case if the model was trained on another split, or if the results are predictions
    for data of another split.

    Args:
        split_list: Identity of the list of the evaluation data; empty if unknown.
        about: Metadata of the result file, in which both keys may be missing: the list of the
            training and the list of the predicted data.
        path: Result file, for the message.

    Raises:
        ValueError: If a list of the results and ``split_list`` are known and differ, or if an
            identity is malformed.
    """
    for name in (TRAINED_ON, SPLIT_LIST):
        require_same_list(
            model=about.get(name),
            data=split_list,
            subject=f"the model of {path}",
            remedy="--allow-other-split",
        )
