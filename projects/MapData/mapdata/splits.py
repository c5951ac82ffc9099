"""Which scenes belong to which split: published lists by name, lists in files, official ones."""

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

OFFICIAL = "official"
_PARTS = ("train", "val", "test")
_FORM = '{"train": ["scene-0001", ...], "val": [...]}, or a text file with a scene a line'


@dataclass(frozen=True)
class SplitList:
    """The scenes of each part of a split, such as ``train`` and ``val``, by name or token.

    Args:
        name: What the list is called.
        scenes: Scenes by part.
        complete: Whether the data set must have all of them, for figures that compare with others.
    """

    name: str
    scenes: Mapping[str, Collection[str]]
    complete: bool = False

    @cached_property
    def identity(self) -> str:
        """Name and digest, as annotation files have it."""
        return list_identity(self.name, self.scenes)

    def missing_note(self, missing: Collection[str], total: int, where: str, allowed: bool) -> str:
        """Say that scenes are not there.

        Raises:
            ValueError: If all must be there, and it is not ``allowed`` that some are missing.
        """
        known = f"{total - len(missing)} of the {total} scenes of the splits are in {where}"
        if self.complete and not allowed:
            raise InputError(
                f"split {self.name!r}: only {known}, {min(missing)!r} is not: add the parts of the "
                "data set that hold the others (docs/data.md), or take those that are there with "
                "--allow-missing, for figures that compare with no others."
            )
        return f"{known}, which has no more."


def _families() -> list[str]:
    """Names of the files of published lists, the oldest list first."""
    names = [Path(file.name).stem for file in files("mapdata").joinpath("split_lists").iterdir()]
    return sorted(names, reverse=True)


def split_names(dataset: str) -> tuple[str, ...]:
    """Return the names of the published splits of a data set, ``nuscenes`` or ``av2``."""
    return tuple(name for family in _families() for name in _family(family)[dataset]["splits"])


def _family(name: str) -> Any:
    """Read a file of lists: groups of scenes, and the groups of each part of its splits."""
    return read_json(Path(str(files("mapdata").joinpath(f"split_lists/{name}.json"))))


def published_split(name: str, dataset: str) -> SplitList:
    """Return a published split of a data set; ValueError if there is none of this name."""
    for family in _families():
        lists = _family(family)[dataset]
        if name in lists["splits"]:
            parts = lists["splits"][name].items()
            scenes = {p: [s for g in groups for s in lists["scenes"][g]] for p, groups in parts}
            return SplitList(name, scenes, complete=True)
    known = ", ".join(split_names(dataset))
    raise InputError(f"there is no split {name!r} of {dataset}: name one of {known}.")


def read_split_file(path: Path) -> SplitList:
    """Read a split file: JSON, an object with a list of scene names or tokens for each split.

    It is the format of the nuScenes devkit's own ``splits.json``. A text file (``.txt``) has the
    scenes of one split, one a line, and the split's name in its own, such as ``av2_val.txt``. The
    list has the file's name.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it has another form.
    """
    if not path.is_file():
        raise FileNotFoundError(f"no split file at {path}.")
    try:
        splits = _lines_of(path) if path.suffix.lower() == ".txt" else read_json(path)
    except ValueError as error:
        raise InputError(f"{str(error).rstrip('.')}; a split file is JSON like {_FORM}.") from error
    if not isinstance(splits, dict) or not all(
        isinstance(scenes, list) and all(isinstance(s, str) for s in scenes)
        for scenes in splits.values()
    ):
        raise InputError(f"split file {path} must look like {_FORM}.")
    return SplitList(file_name(path.stem)[:100], splits)


def _lines_of(path: Path) -> dict[str, list[str]]:
    """Read the scenes of one split, whose name is a word of the file's name."""
    words = [word for word in re.split(r"[^a-z]+", path.stem.lower()) if word in _PARTS]
    if len(set(words)) != 1:
        raise InputError(f"the name of {path} must have one of the words {', '.join(_PARTS)}")
    lines = (line.strip() for line in read_text(path).splitlines())
    return {words[0]: [line for line in lines if line]}


def asked_split(options: Any, dataset: str) -> SplitList | None:
    """Return the list that ``split_name`` or ``split_file`` of the options name, if any."""
    if options.split_name and options.split_file:
        raise InputError("name either --split-name or --split-file.")
    if options.split_name:
        return published_split(options.split_name, dataset)
    return read_split_file(options.split_file) if options.split_file else None


def resolve_scenes(
    splits: Mapping[str, Collection[str]], names: Mapping[str, str]
) -> tuple[dict[str, str], list[str]]:
    """Turn scene names or tokens, by split, into the split of each scene that exists.

    Args:
        splits: Names or tokens by split.
        names: Name of each scene of the data set, by token.

    Returns:
        Splits by the scene's name, and the entries that the data set does not have.

    Raises:
        ValueError: If a scene is in two splits, by its name or its token.
    """
    known = {name: name for name in names.values()} | dict(names)
    split_of: dict[str, str] = {}
    missing = []
    for split, entries in splits.items():
        for entry in entries:
            if entry not in known:
                missing.append(entry)
            elif split_of.setdefault(known[entry], split) != split:
                other = split_of[known[entry]]
                raise InputError(f"scene {known[entry]} is in both {other} and {split}.")
    return split_of, missing
