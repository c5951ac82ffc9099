"""Check that a model and its data sets have an equal range and equal classes."""

from collections.abc import Iterator, Mapping
from typing import Any

from mmengine.config import Config

from gsmap.checkpoints.settings import plain, wrapped_datasets
from gsmap.utils.errors import InputError


def check_map_agreement(cfg: Config, *parts: str, classes_only: bool = False) -> None:
    """Check that the data sets of a config have the range and the classes of its model.

    Other values would train or score a wrong map without an error. A data set that names no range
    or no classes takes them from its annotation file and is not checked.

    Args:
        cfg: The config.
        parts: Splits of the data sets, ``"train"``, ``"val"`` or ``"test"``.
        classes_only: Whether ranges may differ, as in inference, where they do not change the
            predictions.

    Raises:
        ValueError: If a range or the list of classes differs; the message names both settings.
    """
    model_settings = _map_settings(cfg.get("model") or {})
    for part in parts:
        dataset = (cfg.get(f"{part}_dataloader") or {}).get("dataset") or {}
        for prefix, innermost_dataset in _named_datasets(
            dataset, name=f"{part}_dataloader.dataset"
        ):
            dataset_settings = _map_settings(innermost_dataset)
            for name, wanted in model_settings.items():
                if classes_only and name != "classes":
                    continue
                found = dataset_settings.get(name, wanted)
                if found == wanted:
                    continue
                value = "one list, in one order" if name == "classes" else "one range"
                raise InputError(
                    f"{cfg.filename or 'the config'}: model.{name} is {wanted}, but "
                    f"{prefix}.{name} is {found}: set model.{name} and {name} of all data sets to "
                    f"{value}."
                )


def _map_settings(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the range and the classes in the settings of a model or a data set, by dotted name."""
    named: dict[str, Any] = {"classes": settings.get("classes")}
    grid = settings.get("grid")
    if isinstance(grid, Mapping):
        for name in ("x_range", "y_range"):
            named[f"grid.{name}"] = grid.get(name)
    # `plain` converts tuples to lists, so that both compare as equal.
    return {name: plain(value) for name, value in named.items() if value is not None}


def _named_datasets(dataset: Mapping[str, Any], name: str) -> Iterator[tuple[str, Any]]:
    """Yield each data set that is no wrapper of others, with its dotted name.

    Args:
        dataset: Config of a data set or of a wrapper.
        name: Dotted name of this config.
    """
    inner_datasets = wrapped_datasets(dataset)
    if not inner_datasets:
        yield name, dataset
    is_single = dataset.get("dataset") is not None  # such as RepeatDataset
    for index, inner_dataset in enumerate(inner_datasets):
        inner_name = f"{name}.dataset" if is_single else f"{name}.datasets.{index}"
        yield from _named_datasets(inner_dataset, name=inner_name)
