"""Trained models by name: models that ship in ``models/``, and official models of other systems.

``models/registry.json`` lists them. The weights of a model are in ``models/NAME.pth``. Weights of
official models do not ship: users download them to this path.
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
from gsmap.utils.shipped import shipped_path


@dataclass(frozen=True)
class NamedModel:
    """A trained model of the registry.

    Attributes:
        name: Name of the model.
        config: Path of the config in the repository.
        sha256: SHA-256 digest of the weights' file, hexadecimal; None if it is unknown.
        source: Authors of the weights, or address of their project.
        licence: Licence of the weights.
        address: Download address of the weights; None for models that ship.
        figures: Published results on the model's validation split, in percent, by the names of
            this project's metrics.
        image_size: Width and height of the training images after scaling, in pixels.
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
        """File of the weights, which may be missing if the model does not ship."""
        return shipped_path(f"models/{self.name}.pth")


@cache
def named_models() -> dict[str, NamedModel]:
    """Models of the registry by name, whether or not their weights are available."""
    models: dict[str, NamedModel] = {}
    for row in read_json(shipped_path("models/registry.json")):
        models[row["name"]] = NamedModel(**row)
    return models


def model_of_file(path: str | Path) -> NamedModel | None:
    """Model whose weights a file contains; None if it is the file of no named model."""
    resolved = Path(path).resolve()
    for model in named_models().values():
        if model.file.resolve() == resolved:
            return model
    return None


def list_models() -> list[str]:
    """Names of the models whose weights are available: shipped models and fetched ones."""
    return [name for name, model in named_models().items() if model.file.is_file()]


@cache
def named_configs() -> dict[str, Path]:
    """Files of the shipped configs by name (the file name without suffix); no base configs.

    Base configs lie in folders whose names start with an underscore.
    """
    configs: dict[str, Path] = {}
    for pattern in ("configs/*.py", "configs/[!_]*/*.py", "projects/GSMap/configs/*.py"):
        for path in sorted(shipped_path().glob(pattern)):
            configs[path.stem] = path
    return configs


def find_config(config: str | Path) -> Path:
    """Find the file of a config.

    Args:
        config: Path of the file, path in the repository, name of the config, or name of a model.
            They are tried in this order.

    Raises:
        FileNotFoundError: If there is no such config; the message contains the nearest name.
    """
    name = str(config)
    for path in (Path(config), shipped_path(name)):
        if path.is_file():
            return path
    configs = named_configs()
    # The names are cached, so the file may have been removed since they were listed.
    if name in configs and configs[name].is_file():
        return configs[name]
    message_end = f"; configs are in configs/ and projects/GSMap/configs/ of {shipped_path()}"
    model = _find_model(config, kind="config file", message_end=message_end, other_names=configs)
    return shipped_path(model.config)


def find_checkpoint(checkpoint: str | Path) -> Path:
    """Find the file of a checkpoint. The file of a named model is compared with its digest.

    A name refers to the model of the registry even if the working folder contains a file of this
    name; ``./NAME`` refers to the file. A warning is logged if the registry has no digest.

    Args:
        checkpoint: Path of the file, or name of a model.

    Raises:
        FileNotFoundError: If there is no such file or model, or the model's file is absent.
        ValueError: If the digest of the model's file differs from the registry.
    """
    if Path(checkpoint).is_file():
        if str(checkpoint) not in named_models():
            return Path(checkpoint)
        print_log(
            f"{checkpoint} refers to the named model; for the file in the working folder write "
            f"./{checkpoint}.",
            level=logging.WARNING,
        )
    model = _find_model(checkpoint, kind="checkpoint")
    if not model.file.is_file():
        remedy = "check it out again"
        if model.address:
            remedy = f"fetch it from {model.address} and save it there"
        raise FileNotFoundError(f"There is no {model.file}, the weights of {model.name}: {remedy}.")
    if not model.sha256:
        _warn_unverified(model.name)
    elif digest(model.file) != model.sha256:
        raise InputError(
            f"{model.file} is damaged or belongs to another model: its sha256 differs from the one "
            f"of {model.name} in registry.json; fetch it again, or give another file by its path."
        )
    return model.file


@cache
def _warn_unverified(name: str) -> None:
    """Warn that a model's file cannot be verified without a digest.

    The cache limits this to one warning for each model.
    """
    model = named_models()[name]
    print_log(
        f"{model.file} is not verified: {model.source} gives no sha256 for {model.name}; the "
        f"sha256 of this file is {digest(model.file)}.",
        level=logging.WARNING,
    )


def checkpoint_for(config: str | Path, checkpoint: str | Path | None) -> Path:
    """Find the checkpoint that a command tests.

    Args:
        config: Path or name of a config, or name of a model.
        checkpoint: Path of the checkpoint, or name of a model. None selects the weights of the
            model that ``config`` names.

    Raises:
        FileNotFoundError: If the checkpoint or the named model does not exist.
        ValueError: If ``checkpoint`` is None and ``config`` refers to a config, but not to a model;
            or if the digest of a model's file differs from the registry.
    """
    # One name may refer to a config and to a model. Then the checkpoint of the model is taken.
    if checkpoint is not None:
        return find_checkpoint(checkpoint)
    is_config = str(config) in named_configs() or Path(config).is_file()
    if is_config and str(config) not in named_models():
        raise InputError(
            f"give a checkpoint after {config}: only a model's name selects config and checkpoint."
        )
    return find_checkpoint(config)


def _find_model(
    name: str | Path, kind: str, message_end: str = "", other_names: Iterable[str] = ()
) -> NamedModel:
    """Find a model by its name.

    Args:
        name: Name of the model.
        kind: Kind of file that ``name`` may also refer to, for the message of an error.
        message_end: Further text at the end of the message.
        other_names: Further valid names, which the message may suggest.

    Raises:
        FileNotFoundError: If there is no such model. The message contains the nearest name, or
            all models that ship.
    """
    models = named_models()
    if str(name) not in models:
        candidates = [*models, *other_names]
        close_names = difflib.get_close_matches(Path(name).stem, candidates, n=1, cutoff=0.7)
        shipped_names = ", ".join(model.name for model in models.values() if not model.address)
        hint = f"the shipped models are {shipped_names}"
        if close_names:
            hint = f"did you mean {close_names[0]}?"  # it replaces the list of models
        raise FileNotFoundError(
            f"There is no {kind} {name}, and no model of that name ({hint}){message_end}."
        )
    return models[str(name)]
