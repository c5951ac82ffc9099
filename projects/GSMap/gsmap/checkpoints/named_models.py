"""Trained models by name: those that ship in ``models/``, and the official ones of other systems.

``models/registry.json`` lists them; a model's weights are ``models/NAME.pth``. The official ones do
not ship: saved there under their name, they load like the others.
"""

import difflib
import logging
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from mmengine.logging import print_log

from gsmap.utils.errors import InputError
from gsmap.utils.files import read_json
from gsmap.utils.shards import digest
from gsmap.utils.shipped import shipped


@dataclass(frozen=True)
class NamedModel:
    """A trained model of the registry.

    Attributes:
        name: Its name.
        config: Our config, as `shipped` takes it.
        sha256: Digest of the weights' file; None where it is not known.
        source: Who trained it.
        licence: Licence of the weights.
        address: Where its file is fetched; None for those that ship.
        figures: Published results on its validation split in percent, by our metrics' names.
        image_size: Width and height that images were scaled to in training, in pixels.
        can_bus: Whether the training samples had vehicle signals.
    """

    name: str
    config: str
    sha256: str | None
    source: str
    licence: str
    address: str | None
    figures: dict[str, float]
    image_size: list[int]
    can_bus: bool

    @property
    def file(self) -> Path:
        """File of its weights."""
        return shipped(f"models/{self.name}.pth")


@cache
def named_models() -> dict[str, NamedModel]:
    """Return the registry by name."""
    rows = read_json(shipped("models/registry.json"))
    return {row["name"]: NamedModel(**row) for row in rows}


def list_models() -> list[str]:
    """Return the names of the models whose weights are there: those that ship, and fetched ones."""
    return [name for name, model in named_models().items() if model.file.is_file()]


@cache
def named_configs() -> dict[str, Path]:
    """Return the configs that ship, by the names of their files, without those to inherit from."""
    patterns = ("configs/*.py", "configs/[!_]*/*.py", "projects/GSMap/configs/*.py")
    return {path.stem: path for pattern in patterns for path in sorted(shipped().glob(pattern))}


def find_config(config: str | Path) -> Path:
    """Return a config's file, given that, its path in the repository, its name, or a model's name.

    Raises:
        FileNotFoundError: If it is none of these; the message has the nearest name.
    """
    for path in (Path(config), shipped(str(config)), named_configs().get(str(config))):
        if path is not None and path.is_file():
            return path
    remedy = f"; configs are in configs/ and projects/GSMap/configs/ of {shipped()}"
    return shipped(_named(config, "config file", remedy, named_configs()).config)


def find_checkpoint(checkpoint: str | Path) -> Path:
    """Return a checkpoint's file; asked for by name, it is checked against its digest.

    A warning says so where the registry has no digest. A name means the registry's model, whatever
    the working folder holds; ``./NAME`` is a file there.

    Raises:
        FileNotFoundError: If it is neither, or the named model's file is not there.
        ValueError: If the named model's file is not the registry's.
    """
    if Path(checkpoint).is_file():
        if str(checkpoint) not in named_models():
            return Path(checkpoint)
        print_log(
            f"{checkpoint} is the model of that name; the file of that name in the working folder "
            f"is ./{checkpoint}.",
            level=logging.WARNING,
        )
    model = _named(checkpoint, "checkpoint")
    if not model.file.is_file():
        remedy = f"fetch it from {model.address}" if model.address else "check it out again"
        raise FileNotFoundError(
            f"There is no {model.file}, the weights of {model.name}: {remedy} and save it there."
        )
    if not model.sha256:
        _say_unverified(model.name)
    elif digest(model.file) != model.sha256:
        raise InputError(
            f"{model.file} is damaged or another file: its sha256 is not that of {model.name} in "
            "registry.json; fetch it again, or give another file by its path."
        )
    return model.file


@cache
def _say_unverified(name: str) -> None:
    """Say once that nobody knows whether a file is the one that its name promises."""
    model = named_models()[name]
    print_log(
        f"{model.file} is not verified: {model.source} gives no sha256 for {model.name}; that of "
        f"this file is {digest(model.file)}.",
        level=logging.WARNING,
    )


def checkpoint_for(config: str | Path, checkpoint: str | Path | None) -> Path:
    """Return the checkpoint that a command tests: the one given, or that of a named model.

    Raises:
        FileNotFoundError: If it does not exist.
        ValueError: If none is given with a config.
    """
    is_config = str(config) in named_configs() or Path(config).is_file()
    if checkpoint is None and is_config and str(config) not in named_models():
        raise InputError(f"give a checkpoint after {config}: only a model's name stands for both.")
    return find_checkpoint(config if checkpoint is None else checkpoint)


def _named(name: str | Path, what: str, remedy: str = "", others: Iterable[str] = ()) -> NamedModel:
    """Return a model by its name, or raise an error with the nearest, or with all that ship."""
    models = named_models()
    if str(name) not in models:
        close = difflib.get_close_matches(Path(name).stem, [*models, *others], n=1, cutoff=0.7)
        ours = ", ".join(model.name for model in models.values() if not model.address)
        hint = f"did you mean {close[0]}?" if close else f"{ours} ship"
        raise FileNotFoundError(
            f"There is no {what} {name}, and no model of that name ({hint}){remedy}."
        )
    return models[str(name)]
