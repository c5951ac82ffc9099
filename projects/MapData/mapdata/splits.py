"""Splits of a data set: published lists of scenes, and lists in files."""

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib.resources import files
from pathlib import Path
from typing import Any

from gsmap.utils.errors import InputError
from gsmap.utils.files import file_name, read_json, read_text
from gsmap.utils.split_lists import list_identity

OFFICIAL = "official"  # name of the split that the publisher of a data set defines
_PARTS = ("train", "val", "test")  # parts that the name of a text file can give
# Form of a split file, for messages.
_FORM = '{"train": ["scene-0001", ...], "val": [...]}, or a text file with one scene per line'


@dataclass(frozen=True)
class SplitList:
    """The scenes of each part of a split, such as ``train`` and ``val``, by name or token.

    Args:
        name: Name of the list.
        scenes: Names or tokens of scenes, by part.
        complete: Whether the data set must contain all scenes, so that results are comparable.
    """

    name: str
    scenes: Mapping[str, Collection[str]]
    complete: bool = False

    @cached_property
    def identity(self) -> str:
        """Name and digest of the list, ``name@digest``, for annotation files."""
        return list_identity(self.name, scenes=self.scenes)

    def missing_note(self, missing: Collection[str], total: int, where: str, allowed: bool) -> str:
        """Describe missing scenes in a note.

        Args:
            missing: Names or tokens of the missing scenes.
            total: Number of scenes that the data set should have, present and missing.
            where: Name of the data set, for the note.
            allowed: Whether scenes of a complete list may be missing.

        Returns:
            The note.

        Raises:
            ValueError: If the list is complete, and missing scenes are not ``allowed``.
        """
        known = f"{total - len(missing)} of the {total} scenes of the splits are in {where}"
        if self.complete and not allowed:
            raise InputError(
                f"split {self.name!r}: only {known}, and {min(missing)!r} is not: add the parts of "
                "the data set with the missing scenes (docs/data.md), or use the present scenes "
                "with --allow-missing, for figures that are not compared with published ones."
            )
        return f"{known}; the others are missing there."


def _families() -> list[str]:
    """Names of the files of published lists, in the order in which their splits are offered."""
    # Backwards, so that the published lists of disjoint places come first.
    folder = files("mapdata").joinpath("split_lists")
    names = [Path(file.name).stem for file in folder.iterdir()]
    return sorted(names, reverse=True)


def split_names(dataset: str) -> tuple[str, ...]:
    """Names of the published splits of a data set, ``nuscenes`` or ``av2``."""
    names: list[str] = []
    for family in _families():
        names += _read_family(family)[dataset]["splits"]
    return tuple(names)


def _read_family(name: str) -> Any:
    """Read a file of published lists.

    The file has two entries for each data set. ``scenes`` has the list of scenes of each group, by
    the name of the group. ``splits`` has, for each split and each of its parts, the names of the
    groups: ``{"splits": {SPLIT: {"train": [GROUP, ...], ...}}, "scenes": {GROUP: [...]}}``.
    """
    return read_json(Path(str(files("mapdata").joinpath(f"split_lists/{name}.json"))))


def published_split(name: str, dataset: str) -> SplitList:
    """Read a published split of a data set, ``nuscenes`` or ``av2``.

    Raises:
        ValueError: If there is no split with this name.
    """
    # A family is a file with the lists of one publication, for all data sets.
    for family in _families():
        lists = _read_family(family)[dataset]
        if name in lists["splits"]:
            scenes: dict[str, list[str]] = {}
            # A part, such as ``train``, consists of the scenes of several groups.
            for part, groups in lists["splits"][name].items():
                scenes[part] = []
                for group in groups:
                    scenes[part] += lists["scenes"][group]
            return SplitList(name, scenes=scenes, complete=True)
    known = ", ".join(split_names(dataset))
    raise InputError(f"there is no split {name!r} of {dataset}: name one of {known}.")


def read_split_file(path: Path) -> SplitList:
    """Read a split file, in JSON or as text.

    In JSON it is an object with a list of scene names or tokens for each part, such as ``train``
    and ``val``, as in ``splits.json`` of the nuScenes devkit. A text file (``.txt``) has the scenes
    of one part, one per line, and the name of the part in its file name, such as ``av2_val.txt``.

    Returns:
        The list, with the name of the file.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file has another form.
    """
    if not path.is_file():
        raise FileNotFoundError(f"no split file at {path}.")
    try:
        is_text = path.suffix.lower() == ".txt"
        scenes = _read_lines(path) if is_text else read_json(path)  # by part
    except ValueError as error:
        raise InputError(f"{str(error).rstrip('.')}; a split file is JSON like {_FORM}.") from error
    if not isinstance(scenes, dict) or not all(map(_is_list_of_names, scenes.values())):
        raise InputError(f"split file {path} must look like {_FORM}.")
    # The name becomes a part of `SplitList.identity`, which has at most 100 characters of a name,
    # all of them letters, digits and ``_.+=-``. `file_name` replaces all other characters.
    return SplitList(name=file_name(path.stem)[:100], scenes=scenes)


def _is_list_of_names(value: Any) -> bool:
    """Whether a value of a JSON file is a list of texts."""
    return isinstance(value, list) and all(isinstance(name, str) for name in value)


def _read_lines(path: Path) -> dict[str, list[str]]:
    """Read the scenes of one part of a split, by the name of the part, a word of the file's name.

    Raises:
        ValueError: If the file's name has none of the words of `_PARTS`, or two different ones.
    """
    all_words = re.split(r"[^a-z]+", path.stem.lower())
    words = [word for word in all_words if word in _PARTS]
    if len(set(words)) != 1:
        raise InputError(f"the name of {path} must have one of the words {', '.join(_PARTS)}")
    scenes = []
    for line in read_text(path).splitlines():
        if line.strip():
            scenes.append(line.strip())
    return {words[0]: scenes}


def requested_split(options: Any, dataset: str) -> SplitList | None:
    """Read the split that is given by the option ``split_name`` or ``split_file``.

    Args:
        options: Options of a converter (``FileOptions``).
        dataset: Name of the data set, ``nuscenes`` or ``av2``.

    Returns:
        The list; None if the options name no list, for the official split of the data set.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the options name two lists, or the list is not known or malformed.
    """
    if options.split_name and options.split_file:
        raise InputError("name either --split-name or --split-file.")
    if options.split_name:
        return published_split(options.split_name, dataset=dataset)
    return read_split_file(options.split_file) if options.split_file else None


def resolve_scenes(
    splits: Mapping[str, Collection[str]], names: Mapping[str, str]
) -> tuple[dict[str, str], list[str]]:
    """Find the part of a split, such as ``train``, to which each scene of a data set belongs.

    Args:
        splits: Names or tokens of scenes, by part, as in ``SplitList.scenes``.
        names: Name of each scene of the data set, by token.

    Returns:
        Part of each scene, by the scene's name, and the entries that the data set does not have.

    Raises:
        ValueError: If a scene is in two parts, by its name or its token.
    """
    # Name of each scene, by its name and by its token, since an entry of a list may be either.
    name_of = {name: name for name in names.values()} | dict(names)
    part_of: dict[str, str] = {}
    missing = []
    for part, entries in splits.items():
        for entry in entries:
            if entry not in name_of:
                missing.append(entry)
                continue
            name = name_of[entry]
            other = part_of.setdefault(name, part)  # `part` unless the scene already has a part
            if other != part:
                raise InputError(f"scene {name} is in both {other} and {part}.")
    return part_of, missing
