"""A model that was trained on one rig, range and list of classes, on others."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from mmdet3d.registry import HOOKS
from mmengine.config import Config
from mmengine.hooks import Hook
from mmengine.logging import print_log
from torch import Tensor, nn
from torch.nn.functional import interpolate

from gsmap.checkpoints.convert import listed, ours_from_upstream
from gsmap.checkpoints.key_map import is_upstream
from gsmap.checkpoints.named_models import named_models
from gsmap.checkpoints.settings import plain
from gsmap.datasets.annotations.record import MapSample
from gsmap.engine.run_log import innermost
from gsmap.structures.frames import FRAME_VIEWS, viewing_azimuth
from gsmap.utils.errors import InputError
from gsmap.utils.shipped import shipped

if TYPE_CHECKING:
    from mmengine.runner import Runner

    from gsmap.datasets.vectorized_map_dataset import VectorizedMapDataset

# Where the cameras of nuScenes and Argoverse 2 look: degrees to the left of straight ahead.
AZIMUTHS_DEG = {
    "CAM_FRONT": 0, "CAM_FRONT_LEFT": 55, "CAM_FRONT_RIGHT": -55, "CAM_BACK_LEFT": 109,
    "CAM_BACK_RIGHT": -111, "CAM_BACK": 180, "ring_front_center": 0, "ring_front_left": 45,
    "ring_front_right": -45, "ring_side_left": 99, "ring_side_right": -99, "ring_rear_left": 153,
    "ring_rear_right": -153,
}  # fmt: skip


_GENERATED = "map_head.generator.label."  # of a head that fits its detector or none
# Weights with a row for each class, and how many rows are before these.
_CLASS_ROWS = {
    "map_head.cls_branches.": 0, "map_head.cls_branch.": 0, "map_head.detector.cls_branches.": 0,
    "map_head.detector.cls_branch.": 0, _GENERATED: 0,
    "map_head.decoder.maps.0.3.": 1,  # the background
}  # fmt: skip
_LOOK_AT = 100  # samples among which one with all cameras is looked for


def camera_rows(dataset: "VectorizedMapDataset", trained: Sequence[str]) -> list[int]:
    """Say which of a model's cameras each of a data set's is, or looks most like.

    Args:
        dataset: The data set.
        trained: Names of the model's cameras; the result has an index into these for each camera.

    Raises:
        ValueError: If names differ, and it is not known where the model's cameras look.
    """
    names = dataset.cameras or [camera.name for camera in dataset.sample(0).cameras]
    if set(names) <= set(trained):
        return [list(trained).index(name) for name in names]
    first = (dataset.sample(i) for i in range(min(len(dataset), _LOOK_AT)))
    sample = max(first, key=lambda sample: len(sample.cameras))
    return similar_cameras(sample, dataset.metainfo["frame"], names, trained)


def similar_cameras(
    sample: MapSample, frame: str, names: Sequence[str], trained: Sequence[str]
) -> list[int]:
    """Say which of a model's cameras looks most as each camera of a sample does.

    Args:
        sample: A sample.
        frame: Its annotation frame.
        names: Its cameras; one that it lacks counts as looking ahead.
        trained: The model's cameras; the result has an index into these for each name.

    Raises:
        ValueError: If it is not known where the model's cameras look.
    """
    unknown = [name for name in trained if name not in AZIMUTHS_DEG]
    if unknown:
        raise InputError(
            f"the model is for the cameras {list(trained)}, the input has {list(names)}: name them "
            "as the model does."
        )
    looks = np.radians([AZIMUTHS_DEG[name] for name in trained])
    cameras = {camera.name: camera for camera in sample.cameras}
    found = []
    for name in names:
        azimuth = 0.0
        if name in cameras:
            azimuth = viewing_azimuth(cameras[name].cam_from_frame, FRAME_VIEWS[frame])
        found.append(int(np.argmax(np.cos(looks - azimuth))))
    return found


def fit_start(
    state: dict[str, Tensor],
    model: nn.Module,
    dataset: "VectorizedMapDataset",
    origin: Mapping[str, Any],
) -> list[str]:
    """Fit a checkpoint to a model for other cameras, range, cells and classes.

    Args:
        state: The checkpoint's weights; they change in place.
        model: The model, with initial weights.
        dataset: What it is trained on.
        origin: What the checkpoint was trained on: ``cameras``, ``classes``, ``frame``, ``x_range``
            and ``y_range``, as far as they are known.

    Returns:
        A line for each change, and for what training has to learn anew.
    """
    own = model.state_dict()
    lines = _fit_cameras(state, own, dataset, origin.get("cameras"))
    lines += _fit_cells(state, own)
    lines += _fit_queries(state, own, model)
    lines += _fit_classes(state, own, origin.get("classes"), dataset.metainfo["classes"])
    here = dataset.metainfo
    for name, note in (
        ("x_range", "the queries of the map are stretched to it"),
        ("y_range", "the queries of the map are stretched to it"),
        ("frame", "training learns anew where ahead is; samples in the old one would save that"),
    ):
        if name in origin and plain(origin[name]) != plain(here[name]):
            lines.append(f"{name} was {origin[name]}, is {here[name]}: {note}.")
    return lines


def _fit_cameras(
    state: dict[str, Tensor],
    own: Mapping[str, Tensor],
    dataset: "VectorizedMapDataset",
    trained: Sequence[str] | None,
) -> list[str]:
    """Give each camera the embedding of its own, or of the one that looks most like it."""
    key = "bev_encoder.cams_embeds"
    if key not in state or key not in own:
        return []
    embeds, wanted = state[key], len(own[key])
    if trained is None or len(trained) != len(embeds):
        if len(embeds) == wanted:
            return []
        trained = ()
    names = dataset.cameras or [camera.name for camera in dataset.sample(0).cameras]
    if not set(names) <= set(trained) and (not trained or set(trained) - AZIMUTHS_DEG.keys()):
        state[key] = embeds.mean(0, keepdim=True).repeat(wanted, 1)
        return ["its cameras are not known: each camera starts from the mean of their embeddings."]
    rows = camera_rows(dataset, trained)
    state[key] = embeds[rows]
    pairs = [(n, trained[row]) for n, row in zip(names, rows, strict=True) if n != trained[row]]
    if not pairs:
        return []
    return [f"embeddings of cameras: {', '.join(f'{new} as {old}' for new, old in pairs)}."]


def _fit_cells(state: dict[str, Tensor], own: Mapping[str, Tensor]) -> list[str]:
    """Interpolate the queries of the BEV cells and their positional encodings."""
    cells, *sides = (
        f"bev_encoder.{name}.weight"
        for name in (
            "bev_embedding", "positional_encoding.row_embed", "positional_encoding.col_embed",
        )
    )  # fmt: skip
    if not {cells, *sides} <= state.keys() & own.keys():
        return []
    old, new = ([len(weights[side]) for side in sides] for weights in (state, own))
    if old == new or len(state[cells]) != old[0] * old[1]:
        return []
    image = state[cells].float().unflatten(0, old).permute(2, 0, 1)[None]  # (1, C, H, W)
    state[cells] = interpolate(image, new, mode="bilinear")[0].permute(1, 2, 0).flatten(0, 1)
    for side, count in zip(sides, new, strict=True):
        state[side] = interpolate(state[side].float().T[None], count, mode="linear")[0].T
    return [f"queries of {old[0]} x {old[1]} BEV cells interpolated to {new[0]} x {new[1]}."]


def _fit_queries(
    state: dict[str, Tensor], own: Mapping[str, Tensor], model: nn.Module
) -> list[str]:
    """Keep the queries of elements; those that a model with one group has beyond begin as new."""
    key, groups = "map_head.instance_embedding.weight", _query_groups(model)
    if key not in state or key not in own or len(groups) != 1:
        return []
    old, new = len(state[key]), len(own[key])
    if old >= new:
        return []
    state[key] = torch.cat([state[key], own[key][old:].detach().to(state[key])])
    return [f"{old} queries keep their weights, {new - old} begin as new."]


def _query_groups(model: nn.Module) -> Sequence[Any]:
    """Return a head's groups of queries, none where it has no such."""
    return getattr(getattr(model, "map_head", None), "query_groups", ())


def _fit_classes(
    state: dict[str, Tensor],
    own: Mapping[str, Tensor],
    trained: Sequence[str] | None,
    names: Sequence[str],
) -> list[str]:
    """Let classes of the same name keep their weights; others begin as new."""
    if trained is None or list(trained) == list(names):
        return []
    found = {}  # key -> rows before those of the classes
    for prefix, first in _CLASS_ROWS.items():
        sizes = first + len(trained), first + len(names)
        for key in own.keys() & state.keys():
            if key.startswith(prefix) and (len(state[key]), len(own[key])) == sizes:
                found[key] = first
    if all(key.startswith(_GENERATED) for key in found):
        return [
            f"classes were {', '.join(trained)}, are {', '.join(names)}: this head's weights of "
            "classes are taken as they are, where their sizes fit."
        ]
    kept = {name: list(trained).index(name) for name in names if name in trained}
    for key, first in found.items():
        old, state[key] = state[key], own[key].detach().clone().to(state[key])
        state[key][:first] = old[:first]
        for row, name in enumerate(names, first):
            if name in kept:
                state[key][row] = old[first + kept[name]]
    fresh = [name for name in names if name not in kept]
    return [f"classes keep their weights: {listed(list(kept))}; begin as new: {listed(fresh)}."]


@HOOKS.register_module()
class RigFitHook(Hook):
    """Fits the checkpoint that a training starts from to its cameras, range, cells and classes.

    A log line says what is changed. Resumed trainings and tests take checkpoints as they are.
    """

    def after_load_checkpoint(self, runner: "Runner", checkpoint: dict[str, Any]) -> None:
        """Change the weights before the model takes them."""
        if runner._resume or isinstance(runner._train_loop, dict | None):
            return
        dataset = innermost(runner.train_dataloader.dataset)
        state = checkpoint.get("state_dict", checkpoint)
        fitted = {key.removeprefix("module."): value for key, value in state.items()}
        if is_upstream(fitted):
            fitted = ours_from_upstream(fitted)
        model = getattr(runner.model, "module", runner.model)
        origin = _origin(runner._load_from, checkpoint)
        for line in fit_start(fitted, model, dataset, origin):
            print_log(f"{runner._load_from}: {line}", "current")
        state.clear()
        state.update(fitted)


def _origin(path: Any, checkpoint: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a checkpoint was trained on: as it says itself, or as the registry does."""
    said: Any = (checkpoint.get("meta") or {}).get("dataset_meta") or {}
    for model in named_models().values():
        if not said and Path(str(path)) == model.file:
            said = dict(Config.fromfile(shipped(model.config)).train_dataloader.dataset)
            said |= said["grid"]
    if not isinstance(said, Mapping):
        return {}
    kinds = {"cameras": str, "classes": str, "frame": str, "x_range": float, "y_range": float}
    known = {name: said[name] for name in kinds if isinstance(said.get(name), list | tuple | str)}
    return {n: v for n, v in known.items() if all(isinstance(value, kinds[n]) for value in v)}
