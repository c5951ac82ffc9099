"""A folder of reference data: its recipes, inputs and models with its weights."""

import importlib.util
import json
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar
from unittest.mock import patch

import numpy as np
import torch
from mmdet3d.registry import MODELS
from mmengine.config import Config
from mmengine.model import BaseModel
from mmengine.registry import init_default_scope
from torch import Tensor
from unset_weights import unset_weights

from gsmap import registered  # noqa: F401
from gsmap.checkpoints.key_map import key_maps

NUM_CAMS = 6
Output = TypeVar("Output")


@dataclass(eq=False)
class Golden:
    """Reference data of one variant.

    Attributes:
        folder: Folder of the reference files.
        configs: The project's ``configs`` folder.
        variant: Suffix of the variant's files, as in ``maptr_r50_forward_full_A.npz``.
        seed: Seed string of the recipes of weights and inputs.
        recipes: Folder of ``weights_recipe.py`` and ``inputs_recipe.py``; None means ``folder``.
    """

    folder: Path
    configs: Path
    variant: str = "A"
    seed: str = "A"
    recipes: Path | None = None
    _models: dict[str, BaseModel] = field(default_factory=dict, repr=False)
    _states: dict[str, dict[str, Tensor]] = field(default_factory=dict, repr=False)
    _outputs: dict[str, Any] = field(default_factory=dict, repr=False)

    def _file(self, name: str) -> Path:
        """Return the file of a recipe, there or not."""
        return (self.recipes or self.folder) / f"{name}.py"

    def _module(self, name: str) -> ModuleType:
        """Load a recipe.

        Raises:
            FileNotFoundError: If the folder has no such recipe.
        """
        path = self._file(name)
        if not path.is_file():
            raise FileNotFoundError(f"no {path}: give the folder of the recipes with --recipes.")
        spec = importlib.util.spec_from_file_location(f"golden_{name}", path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    @cached_property
    def weights(self) -> ModuleType:
        """The recipe of weights: ``tensor(key, shape, seed)``."""
        return self._module("weights_recipe")

    @cached_property
    def inputs(self) -> ModuleType:
        """The recipe of inputs: ``images(h, w, cameras, seed)`` and others."""
        return self._module("inputs_recipe")

    @cache  # noqa: B019 - a few per run
    def recipe(self, method: str) -> ModuleType:
        """Return a method's own recipe of weights and inputs: ``tensor``, ``normal``, ``mask``."""
        beside = {"inputs_recipe": self.inputs, "weights_recipe": self.weights}
        with patch.dict(sys.modules, beside):  # some recipes import these
            return self._module(f"{method}_recipe")

    @cached_property
    def cameras(self) -> dict[str, Any]:
        """Cameras of the variant."""
        return self.read_json(f"cameras_{self.variant}.json")

    @cached_property
    def gt_sets(self) -> dict[str, list[dict[str, Any]]]:
        """Sets of annotated elements: ``label`` and ``pts`` (n, 2) in metres."""
        return self.read_json(f"gt_{self.variant}.json")["sets"]

    def read_json(self, name: str) -> Any:
        """Read a JSON file of the folder."""
        return json.loads((self.folder / name).read_text())

    def read_arrays(self, name: str) -> dict[str, np.ndarray]:
        """Read an ``.npz`` file of the folder."""
        with np.load(self.folder / name, allow_pickle=False) as arrays:
            return dict(arrays)

    def state_shapes(self, name: str) -> dict[str, tuple[int, ...]]:
        """Return key -> shape of an upstream state list."""
        return {key: tuple(entry["shape"]) for key, entry in self.read_json(name)["state"].items()}

    def upstream_state(self, name: str) -> dict[str, Tensor]:
        """Return the upstream state that the recipe makes for a state list; the last is kept."""
        if name not in self._states:
            self._states = {name: self._make_state(name)}
        return dict(self._states[name])

    def _make_state(self, name: str) -> dict[str, Tensor]:
        """Have the recipe make the weights of a state list."""
        method = name.split("_")[0]
        recipe = self.recipe(method) if self._file(f"{method}_recipe").is_file() else self.weights
        if hasattr(recipe, "state"):
            arrays = recipe.state(self.state_shapes(name), self.seed)
            return {key: torch.from_numpy(np.asarray(value)) for key, value in arrays.items()}
        (unused,) = (key_map.unused for key_map in key_maps() if key_map.name == method)
        state = {}
        for key, shape in self.state_shapes(name).items():
            value = recipe.tensor(key, shape, self.seed)
            made = unused[key] if value is None else torch.from_numpy(np.asarray(value))
            state[key] = torch.zeros(shape) if made is None else made  # a setting of its own
        return state

    def model(self, config: str, state_list: str) -> BaseModel:
        """Build a model, load the recipe's weights in upstream's format, and set it to eval.

        Args:
            config: Path of the config below ``configs``.
            state_list: Name of the upstream state list.

        Returns:
            The model; one per config, built once.
        """
        if config not in self._models:
            init_default_scope("mmdet3d")
            cfg = Config.fromfile(self.configs / config, import_custom_modules=False)
            with unset_weights():
                model = MODELS.build(cfg.model)
            model.load_state_dict(self.upstream_state(state_list))
            self._models[config] = model.eval()
        return self._models[config]

    def once(self, name: str, make: Callable[[], Output]) -> Output:
        """Return outputs of a model that several files share.

        Args:
            name: Name of the outputs, unique among all checks.
            make: Computes the outputs, without a gradient, if they are not there.
        """
        if name not in self._outputs:
            with torch.no_grad():
                self._outputs[name] = make()
        return self._outputs[name]

    def forget_outputs(self) -> None:
        """Delete the outputs of `once`, since a weight of a model has changed."""
        self._outputs.clear()

    def images(self, size: str) -> Tensor:
        """Return the normalised images of a size (``full`` or ``reduced``). (1, V, 3, H, W)"""
        height, width = self.cameras[size]["padded_hw"]
        return torch.from_numpy(self.inputs.images(height, width, NUM_CAMS, self.seed))[None]

    def meta(self, size: str) -> dict[str, Any]:
        """Return the meta dict of a size's sample."""
        cameras = [self.cameras["cameras"][name] for name in self.cameras["camera_order"]]
        camera2ego = np.array([camera["camera2ego"] for camera in cameras])
        return {
            "token": f"{size}_{self.variant}",
            "batch_input_shape": tuple(self.cameras[size]["padded_hw"]),
            "lidar2img": np.array(self.cameras[size]["lidar2img"]),
            "cam2img": np.array([camera["intrinsics_1600x900"] for camera in cameras]),
            "lidar2cam": np.linalg.inv(camera2ego) @ np.array(self.cameras["lidar2ego"]),
            "lidar2ego": np.array(self.cameras["lidar2ego"]),
            "cam2ego": camera2ego,
            "img_aug_matrix": np.array([self.cameras[size]["img_aug_matrix"]] * NUM_CAMS),
            "can_bus": np.zeros(18),
        }
