"""Adaptation of checkpoints to models for other cameras, ranges, BEV cells and classes.

The cameras of a vehicle together are called a rig.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from mmdet3d.registry import HOOKS
from mmengine.config import Config
from mmengine.hooks import Hook
from mmengine.logging import print_log
from torch import Tensor, nn
from torch.nn.functional import interpolate

from gsmap.checkpoints.class_axes import ClassAxis
from gsmap.checkpoints.convert import ours_from_upstream, summarize_names
from gsmap.checkpoints.key_map import is_upstream
from gsmap.checkpoints.named_models import model_of_file
from gsmap.checkpoints.settings import plain
from gsmap.datasets.annotations.record import MapSample
from gsmap.engine.run_log import innermost
from gsmap.structures.frames import FRAME_VIEWS, viewing_azimuth
from gsmap.utils.errors import InputError
from gsmap.utils.shipped import shipped_path

if TYPE_CHECKING:
    from mmengine.runner import Runner

    from gsmap.datasets.vectorized_map_dataset import VectorizedMapDataset

# Viewing directions of the cameras of nuScenes and Argoverse 2: degrees to the left of ahead.
AZIMUTHS_DEG = {
    "CAM_FRONT": 0, "CAM_FRONT_LEFT": 55, "CAM_FRONT_RIGHT": -55, "CAM_BACK_LEFT": 109,
    "CAM_BACK_RIGHT": -111, "CAM_BACK": 180, "ring_front_center": 0, "ring_front_left": 45,
    "ring_front_right": -45, "ring_side_left": 99, "ring_side_right": -99, "ring_rear_left": 153,
    "ring_rear_right": -153,
}  # fmt: skip

# Prefix of the class embeddings of a generator of polylines. They are reordered only together with
# the class weights of a detector.
_GENERATOR_LABELS = "map_head.generator.label."
_MAX_SAMPLES = 100  # number of samples that are searched for one with all cameras


def camera_rows(dataset: "VectorizedMapDataset", trained: Sequence[str]) -> list[int]:
    """Assign a camera of the model to each camera of a data set.

    Cameras are assigned by name if the model has a camera of each name. Otherwise all of them are
    assigned by viewing direction (`similar_cameras`).

    Args:
        dataset: The data set.
        trained: Names of the model's cameras.

    Returns:
        An index into ``trained`` for each camera of the data set.

    Raises:
        ValueError: If the names differ, and the viewing directions of the model's cameras are
            unknown.
    """
    names = camera_names(dataset)
    if set(names) <= set(trained):
        trained_names = list(trained)
        return [trained_names.index(name) for name in names]
    num_samples = min(len(dataset), _MAX_SAMPLES)
    samples = map(dataset.sample, range(num_samples))
    fullest_sample = max(samples, key=lambda sample: len(sample.cameras))
    frame = dataset.metainfo["frame"]  # "lidar" or "ego", the annotation frame
    return similar_cameras(fullest_sample, frame=frame, names=names, trained=trained)


def camera_names(dataset: "VectorizedMapDataset") -> Sequence[str]:
    """Return the names of a data set's cameras; by default the cameras of its first sample."""
    if dataset.cameras:
        return dataset.cameras
    first_sample = dataset.sample(0)
    return [camera.name for camera in first_sample.cameras]


def similar_cameras(
    sample: MapSample, frame: str, names: Sequence[str], trained: Sequence[str]
) -> list[int]:
    """Find the camera of the model with the nearest viewing direction for each camera of a sample.

    Args:
        sample: Sample with the poses of the cameras.
        frame: Annotation frame of the sample: ``"lidar"`` or ``"ego"``.
        names: Names of the sample's cameras. An absent camera counts as a front camera.
        trained: Names of the model's cameras.

    Returns:
        An index into ``trained`` for each name.

    Raises:
        ValueError: If the viewing directions of the model's cameras are unknown.
    """
    if not set(trained) <= AZIMUTHS_DEG.keys():
        raise InputError(
            f"the model is for the cameras {list(trained)}, the input has {list(names)}: name them "
            "as the model does."
        )
    trained_azimuths = np.radians([AZIMUTHS_DEG[name] for name in trained])
    cameras = {camera.name: camera for camera in sample.cameras}
    rows: list[int] = []
    for name in names:
        azimuth = 0.0
        if name in cameras:
            azimuth = viewing_azimuth(cameras[name].cam_from_frame, FRAME_VIEWS[frame])
        similarity = np.cos(trained_azimuths - azimuth)  # largest for the nearest direction
        rows.append(int(np.argmax(similarity)))
    return rows


def fit_start(
    state: dict[str, Tensor],
    model: nn.Module,
    dataset: "VectorizedMapDataset",
    origin: Mapping[str, Any],
) -> list[str]:
    """Fit a checkpoint to a model for other cameras, range, BEV cells and classes.

    Args:
        state: Weights of the checkpoint; changed in place.
        model: Model with its initial weights.
        dataset: Data set of the new training.
        origin: Facts about the training of the checkpoint, as far as known: ``cameras``,
            ``classes``, ``frame``, ``x_range`` and ``y_range``.

    Returns:
        A line for each change of a weight, and for each difference that training must adapt to.
    """
    initial = model.state_dict()
    metainfo = dataset.metainfo
    lines = _fit_cameras(state, initial=initial, dataset=dataset, trained=origin.get("cameras"))
    lines += _fit_cells(state, initial=initial)
    lines += _fit_queries(state, initial=initial, model=model)
    lines += _fit_classes(
        state, model=model, trained=origin.get("classes"), names=metainfo["classes"]
    )
    notes = {
        "x_range": "the queries of the map are stretched to it",
        "y_range": "the queries of the map are stretched to it",
        "frame": "training must learn which axis points ahead, unless samples are in the old frame",
    }
    for name, note in notes.items():
        # `plain` turns tuples into lists, so that equal ranges compare as equal.
        if name in origin and plain(origin[name]) != plain(metainfo[name]):
            lines.append(f"{name} was {origin[name]}, is {metainfo[name]}: {note}.")
    return lines


def _fit_cameras(
    state: dict[str, Tensor],
    initial: Mapping[str, Tensor],
    dataset: "VectorizedMapDataset",
    trained: Sequence[str] | None,
) -> list[str]:
    """Fit the camera embeddings to the cameras of a data set.

    Args:
        state: Weights of the checkpoint; changed in place.
        initial: Initial weights of the model.
        dataset: Data set of the new training.
        trained: Names of the checkpoint's cameras; None if unknown.

    Returns:
        A line about the change, if there is one.
    """
    key = "bev_encoder.cams_embeds"
    if key not in state or key not in initial:
        return []
    embeds = state[key]  # (V_old, C)
    num_cameras = len(initial[key])
    if trained is None or len(trained) != len(embeds):
        if len(embeds) == num_cameras:  # assume that the cameras are equal
            return []
        trained = ()  # no known names
    names = camera_names(dataset)
    names_are_known = set(names) <= set(trained)
    directions_are_known = bool(trained) and set(trained) <= AZIMUTHS_DEG.keys()
    if not names_are_known and not directions_are_known:
        state[key] = embeds.mean(0, keepdim=True).repeat(num_cameras, 1)  # (V, C)
        return ["its cameras are not known: each camera starts from the mean of their embeddings."]
    rows = camera_rows(dataset, trained=trained)
    state[key] = embeds[rows]  # (V, C)
    replacements: list[str] = []
    for name, row in zip(names, rows, strict=True):
        if name != trained[row]:
            replacements.append(f"{name} as {trained[row]}")
    if not replacements:
        return []
    return [f"embeddings of cameras: {', '.join(replacements)}."]


def _fit_cells(state: dict[str, Tensor], initial: Mapping[str, Tensor]) -> list[str]:
    """Interpolate the queries of the BEV cells and their positional encodings.

    Args:
        state: Weights of the checkpoint; changed in place.
        initial: Initial weights of the model.

    Returns:
        A line about the change, if there is one.
    """
    cells_key = "bev_encoder.bev_embedding.weight"  # one query per cell, row by row
    rows_key = "bev_encoder.positional_encoding.row_embed.weight"
    columns_key = "bev_encoder.positional_encoding.col_embed.weight"
    common_keys = state.keys() & initial.keys()
    if not {cells_key, rows_key, columns_key} <= common_keys:
        return []
    old_size = [len(state[rows_key]), len(state[columns_key])]
    new_size = [len(initial[rows_key]), len(initial[columns_key])]
    if old_size == new_size or len(state[cells_key]) != old_size[0] * old_size[1]:
        return []
    image = state[cells_key].float().unflatten(0, old_size).permute(2, 0, 1)[None]  # (1, C, H, W)
    image = interpolate(image, new_size, mode="bilinear")
    state[cells_key] = image[0].permute(1, 2, 0).flatten(0, 1)  # (H * W, C)
    for key, count in zip((rows_key, columns_key), new_size, strict=True):
        encodings = state[key].float().T[None]  # (1, C, H or W)
        state[key] = interpolate(encodings, count, mode="linear")[0].T  # (H or W, C)
    old_text = f"{old_size[0]} x {old_size[1]}"
    return [f"queries of {old_text} BEV cells interpolated to {new_size[0]} x {new_size[1]}."]


def _fit_queries(
    state: dict[str, Tensor], initial: Mapping[str, Tensor], model: nn.Module
) -> list[str]:
    """Append queries from the initial weights if the checkpoint has fewer than the model.

    Only models with one group of queries are changed. With several groups, appended queries would
    not belong to the first group, the only one that predicts.

    Args:
        state: Weights of the checkpoint; changed in place.
        initial: Initial weights of the model.
        model: The model.

    Returns:
        A line about the change, if there is one.
    """
    key = "map_head.instance_embedding.weight"
    head = getattr(model, "map_head", None)
    query_groups = getattr(head, "query_groups", ())
    if key not in state or key not in initial or len(query_groups) != 1:
        return []
    old_count = len(state[key])
    new_count = len(initial[key])
    if old_count >= new_count:
        return []
    added = initial[key][old_count:].detach().to(state[key])
    state[key] = torch.cat([state[key], added])  # (N, C)
    return [f"{old_count} queries keep their weights, {new_count - old_count} begin as new."]


def _fit_classes(
    state: dict[str, Tensor], model: nn.Module, trained: Sequence[str] | None, names: Sequence[str]
) -> list[str]:
    """Reorder the weights of classes by name. New classes keep their initial weights.

    Args:
        state: Weights of the checkpoint; changed in place.
        model: Model with its initial weights.
        trained: Classes of the checkpoint; None if unknown.
        names: Classes of the model.

    Returns:
        A line about the change, if there is one.
    """
    if trained is None or list(trained) == list(names):
        return []
    axes = _find_class_axes(state, model=model, old_count=len(trained), new_count=len(names))
    # Nothing is reordered if there are no class weights, or only the embeddings of a generator.
    if all(key.startswith(_GENERATOR_LABELS) for key in axes):
        return [
            f"classes were {', '.join(trained)}, are {', '.join(names)}: this head's weights of "
            "classes are loaded without a change of their order, where their sizes fit."
        ]
    old_rows: dict[str, int] = {}  # index among the classes of the checkpoint, by class
    new_classes: list[str] = []
    for name in names:
        if name in trained:
            old_rows[name] = list(trained).index(name)
        else:
            new_classes.append(name)
    initial = model.state_dict()
    for key, axis in axes.items():
        old_weights = state[key]
        weights = initial[key].detach().clone().to(old_weights)
        new_entries = list(range(axis.first))  # entries before the classes keep their place
        old_entries = list(range(axis.first))
        for row, name in enumerate(names):
            if name in old_rows:
                new_entries += _class_entries(axis, row)
                old_entries += _class_entries(axis, old_rows[name])
        device = old_weights.device
        kept = old_weights.index_select(axis.dim, torch.tensor(old_entries, device=device))
        target = torch.tensor(new_entries, device=device)
        state[key] = weights.index_copy(axis.dim, target, kept)
    with_weights = summarize_names(list(old_rows))
    without_weights = summarize_names(new_classes)
    dropped_classes = [name for name in trained if name not in names]
    dropped = summarize_names(dropped_classes)
    return [
        f"classes keep their weights: {with_weights}; begin as new: {without_weights}; are left "
        f"out: {dropped}."
    ]


def _class_entries(axis: ClassAxis, index: int) -> range:
    """Return the indices of the entries of a class along an axis."""
    start = axis.first + index * axis.size
    return range(start, start + axis.size)


def _find_class_axes(
    state: Mapping[str, Tensor], model: nn.Module, old_count: int, new_count: int
) -> dict[str, ClassAxis]:
    """Find the weights with entries for each class (`mark_classes`).

    Args:
        state: Weights of the checkpoint.
        model: The model.
        old_count: Number of classes of the checkpoint.
        new_count: Number of classes of the model.

    Returns:
        The axis of the classes, by key. Weights that do not have the numbers of classes are left
        out.
    """
    axes: dict[str, ClassAxis] = {}
    # A layer that a model contains several times has a key for each of its places.
    for name, layer in model.named_modules(remove_duplicate=False):
        axis = getattr(layer, "class_axis", None)
        if not isinstance(axis, ClassAxis):
            continue
        for parameter_name, parameter in layer.named_parameters(recurse=False):
            key = f"{name}.{parameter_name}"
            # A bias has one axis, so it has no entries for classes that are inputs.
            if key not in state or axis.dim >= parameter.dim():
                continue
            old_shape = list(parameter.shape)
            old_shape[axis.dim] = axis.first + old_count * axis.size
            new_size = axis.first + new_count * axis.size
            if list(state[key].shape) == old_shape and parameter.shape[axis.dim] == new_size:
                axes[key] = axis
    return axes


@HOOKS.register_module()
class RigFitHook(Hook):
    """Hook that fits the initial checkpoint of a training to the model (`fit_start`).

    Each change is logged. Checkpoints of resumed trainings and of tests are not changed.
    """

    def after_load_checkpoint(self, runner: "Runner", checkpoint: dict[str, Any]) -> None:
        """Change the weights of a checkpoint before the model loads them.

        Args:
            runner: Runner of the training.
            checkpoint: Contents of the checkpoint; changed in place.
        """
        # In a test, no training loop is built: the attribute is still a config, or None.
        if runner._resume or isinstance(runner._train_loop, dict | None):
            return
        # The first of several data sets, whose cameras, classes, range and frame are equal.
        dataset = innermost(runner.train_dataloader.dataset)[0]
        state = checkpoint.get("state_dict", checkpoint)
        # A model for several GPUs is wrapped. Its wrapper adds the prefix "module." to all keys.
        weights = {}
        for key, value in state.items():
            weights[key.removeprefix("module.")] = value
        if is_upstream(weights):  # keys of the code of the model's authors
            weights = ours_from_upstream(weights)
        model = getattr(runner.model, "module", runner.model)
        meta: Any = checkpoint.get("meta") or {}
        origin = training_facts(runner._load_from, dataset_meta=meta.get("dataset_meta"))
        for line in fit_start(weights, model=model, dataset=dataset, origin=origin):
            print_log(f"{runner._load_from}: {line}", logger="current")
        state.clear()  # the runner loads this dictionary, so it is changed in place
        state.update(weights)


def training_facts(path: Any, dataset_meta: Any) -> dict[str, Any]:
    """Collect facts about the training of a checkpoint.

    They are taken from the metadata of the checkpoint. If the checkpoint of a named model has no
    metadata, they are taken from the model's config. Facts of a wrong type are left out.

    Args:
        path: File of the checkpoint.
        dataset_meta: Metadata of the training's data set in the file, not checked; None or empty
            if it has none.

    Returns:
        The known facts among ``cameras``, ``classes``, ``frame``, ``x_range`` and ``y_range``.
    """
    metadata: Any = dataset_meta or {}
    model = None if metadata else model_of_file(str(path))
    if model is not None:
        config = Config.fromfile(shipped_path(model.config))
        metadata = dict(config.train_dataloader.dataset)
        metadata |= metadata["grid"]  # x_range and y_range
    if not isinstance(metadata, Mapping):
        return {}
    item_types = {"cameras": str, "classes": str, "frame": str, "x_range": float, "y_range": float}
    facts: dict[str, Any] = {}
    for name, item_type in item_types.items():
        value = metadata.get(name)
        if not isinstance(value, list | tuple | str):
            continue
        # The items of a string, such as the name of the frame, are its characters.
        if all(isinstance(item, item_type) for item in value):
            facts[name] = value
    return facts
