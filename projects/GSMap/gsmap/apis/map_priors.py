"""Files of map priors for a model that reads one.

A map prior is the map of a place from earlier drives. The model reads it as a further input.
"""

from collections.abc import Collection, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from mmengine.dist import all_reduce

from gsmap.prior.map_prior import MapPrior
from gsmap.utils.errors import InputError
from gsmap.utils.shards import digest
from gsmap.utils.words import format_count

if TYPE_CHECKING:  # the module is slow to import, so `open_priors` imports it when it is called
    from gsmap.prior.opening import AnyPrior


def require_prior(model: Any) -> None:
    """Raise ValueError if a model takes no prior."""
    if model.prior is None:
        raise InputError(
            "the model takes no prior: leave the prior out, or set model.prior.type=ElementFusion "
            "to fuse the detections with a prior of elements."
        )


def maps_for(model: Any, priors: "Sequence[AnyPrior]", update: bool = False) -> Any:
    """Prepare the priors of a user for a model.

    Args:
        model: A `MapDetector`.
        priors: The priors, one for each place.
        update: Whether to write the prediction of each frame to the prior of its place.

    Returns:
        Maps to pass to ``model.prior.use``, or to the context manager ``model.prior.using``. The
        prior module of the model takes the prior of each sample from them.

    Raises:
        TypeError: If a prior is none, such as the path of its file.
        ValueError: If the model takes no prior, if a prior does not fit it, if two priors are of
            one place, or if ``update`` is set and there is no prior or the model writes to none.
    """
    require_prior(model)
    for prior in priors:
        if not hasattr(prior, "settings"):
            raise TypeError(
                f"a prior is opened by gsmap.prior.open_prior(FILE), got {prior!r:.60}."
            )
    if update and not priors:
        raise InputError("there is no prior to update: give one, or leave the update out.")
    return model.prior.maps_of(priors, update=update)


def use_priors(model: Any, paths: Sequence[Path], stack: ExitStack) -> "list[AnyPrior]":
    """Let a model read files of priors in all later tests, without changing the files.

    Args:
        model: A `MapDetector`.
        paths: The files, one for each place.
        stack: Context that closes the priors at its end. The model must not read them later.

    Returns:
        The priors in the order of ``paths``.

    Raises:
        FileNotFoundError: If a file does not exist.
        ValueError: If the model takes no prior, or a prior is invalid or does not fit it.
    """
    priors = open_priors(model, paths=paths, stack=stack)
    model.prior.use(maps_for(model, priors))
    return priors


def empty_reads(priors: "Sequence[AnyPrior]") -> list[str]:
    """Describe how often each prior had nothing near a sample, in a test by several processes too.

    Args:
        priors: The priors, which samples have been read at. All processes must call this function.

    Returns:
        A line for each prior that had nothing in the range of at least one sample.
    """
    lines = []
    for prior in priors:
        counts = torch.tensor([prior.reads.samples, prior.reads.empty])
        all_reduce(counts)  # sums the counts of all processes, in place
        samples, empty = counts.tolist()
        if not empty:
            continue
        line = (
            f"the prior of {prior.settings.place!r} has nothing in the range of {empty} of "
            f"{format_count(samples, 'sample')}"
        )
        if empty == samples:
            line += ", so it changed nothing: compare its global frame with that of the poses"
        lines.append(f"{line}.")
    return lines


def facts_of_priors(
    priors: "Sequence[AnyPrior]", paths: Sequence[Path], tokens: Sequence[str]
) -> list[dict[str, Any]]:
    """Describe the priors of a run, for the header of its results.

    Args:
        priors: The priors, before the run changes them.
        paths: Their files.
        tokens: Tokens of the samples of the run.

    Returns:
        For each prior its place, the digest of its file, the number of samples that it was made of
        (0 if they are unknown), and how many of these are samples of the run.
    """
    facts = []
    for prior, path in zip(priors, paths, strict=True):
        facts.append(
            {
                "place": prior.settings.place,
                "digest": digest(path),
                "made_of": len(prior.sources),
                "also_predicted": prior.sources.count(tokens),
            }
        )
    return facts


def leak_warnings(facts: Sequence[Mapping[str, Any]], num_samples: int) -> list[str]:
    """Describe how many samples of a run its priors were made of.

    Args:
        facts: Facts of the priors (`facts_of_priors`).
        num_samples: Number of samples of the run.

    Returns:
        A line for each prior that was made of at least one sample of the run.
    """
    lines = []
    for fact in facts:
        if fact["also_predicted"]:
            lines.append(
                f"leak: {fact['also_predicted']} of {format_count(num_samples, 'sample')} are "
                f"among the {fact['made_of']} that the prior of {fact['place']!r} was made of, so "
                "their figures are too good: make the prior of other drives."
            )
    return lines


def open_priors(
    model: Any,
    paths: Sequence[Path],
    stack: ExitStack,
    update: bool = False,
    places: Collection[str] = (),
) -> "list[AnyPrior]":
    """Open files of priors until the end of a context.

    Args:
        model: A `MapDetector`, which must take a prior. A new file gets the classes and the cells
            of the model, and its rule for writing predictions.
        paths: The files.
        stack: Context that closes the priors at its end.
        update: Whether to reserve the files, so that they can be saved later. A file that does not
            exist is then created, for the place that the other files do not have.
        places: Places of the samples. An unknown place is an empty name, in whose stead a created
            file gets its own name without suffix.

    Returns:
        The priors in the order of ``paths``; open until the end of ``stack``.

    Raises:
        FileNotFoundError: If a file does not exist and is not to be updated.
        ValueError: If the model takes no prior, if a file is no valid prior, or if a file is to be
            created and the model writes to no prior or the place of the file is not certain.
        RuntimeError: If a file is reserved by another process.
    """
    from gsmap.prior.opening import open_prior

    require_prior(model)
    new_paths = []
    known_paths = []
    for path in paths:
        if update and not path.exists():
            new_paths.append(path)
        else:
            known_paths.append(path)
    priors: dict[Path, AnyPrior] = {}
    # Files that are created come last, because the places of the others decide on theirs.
    for path in [*known_paths, *new_paths]:
        if path in new_paths:
            other_places = set(places)
            for known_prior in priors.values():
                other_places.discard(known_prior.settings.place)
            place = _new_place(new_paths, places=other_places)
            with model.prior.new_prior(place) as empty_prior:
                empty_prior.save(path)
        prior = open_prior(path, update=update)
        if isinstance(prior, MapPrior):  # priors of other types keep no file open
            stack.enter_context(prior)
        priors[path] = prior
    return [priors[path] for path in paths]


def _new_place(paths: Sequence[Path], places: Collection[str]) -> str:
    """Name of the place of a prior that is created.

    Args:
        paths: All files that are to be created.
        places: Places of the samples that have no prior; an empty name if the place is unknown.

    Raises:
        ValueError: If there is not exactly one file and one place.
    """
    if len(paths) == len(places) == 1:
        (place,) = places
        return place or paths[0].stem
    files = " and ".join(map(str, paths))
    subject = f"{files} does" if len(paths) == 1 else f"{files} do"
    place_names = []
    for place in places:
        place_names.append(place or "an unknown place")
    names = ", ".join(sorted(place_names))
    raise InputError(
        f"{subject} not exist, and the samples without a prior are in {names or 'no other place'}: "
        "make the prior of each place from the samples of this place alone, by --token or a "
        "separate input."
    )
