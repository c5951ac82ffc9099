"""Our modules with the weights of a method's recipe, and their gradients."""

from collections.abc import Iterator, Mapping

import numpy as np
import torch
from mmengine.registry import init_default_scope
from torch import Tensor, nn

from gsmap.checkpoints.key_rules import KeyMap
from reference.golden import Golden
from reference.report import Row, largest_difference

GRAD_L2, GRAD_NORM, GRAD_DOT = 1e-2, 2e-3, 1e-2


class GoldenParts:
    """Our modules with the recipe's weights, and the recipe's inputs in our layout."""

    def __init__(self, golden: Golden, method: str, key_map: KeyMap) -> None:
        init_default_scope("mmdet3d")
        self.golden, self.recipe, self.key_map = golden, golden.recipe(method), key_map

    def load(self, module: nn.Module, prefix: str) -> nn.Module:
        """Fill a module that lies at ``prefix`` of our model, without dropout."""
        state = {}
        for key, value in module.state_dict().items():
            upstream = self.key_map.to_upstream(prefix + key)
            state[key] = torch.from_numpy(
                self.recipe.tensor(upstream, value.shape, self.golden.seed)
            )
        module.load_state_dict(state)
        return module.eval()

    def normal(self, name: str, shape: tuple[int, ...], **settings: float) -> Tensor:
        """Return a normal array of the recipe."""
        return torch.from_numpy(self.recipe.normal(name, shape, self.golden.seed, **settings))

    def gradients_of(
        self, module: nn.Module, prefix: str, upstream_prefix: str = ""
    ) -> dict[str, Tensor]:
        """Return gradients by upstream's key, without its prefix."""
        return {
            self.key_map.to_upstream(prefix + key).removeprefix(upstream_prefix): parameter.grad
            for key, parameter in module.named_parameters()
            if parameter.grad is not None
        }

    def gradient_rows(
        self,
        name: str,
        tag: str,
        data: Mapping[str, np.ndarray],
        gradients: Mapping[str, Tensor],
        norm: float = GRAD_NORM,
        dot: float = GRAD_DOT,
        short: str = "",
    ) -> Iterator[Row]:
        """Compare the norm of each parameter's gradient, and its product with a noise."""
        keys = [str(key) for key in data["grad_keys"]]
        yield Row(name, f"{tag}parameters without gradient", len(set(keys) - set(gradients)), 0)
        norms, dots = [], []
        for key in keys:
            gradient = gradients[key].double().numpy()
            noise = self.recipe.in_rng(f"gdot:{key.removeprefix(short)}", self.golden.seed)
            norms.append(np.linalg.norm(gradient))
            dots.append((gradient * noise.standard_normal(gradient.shape)).sum())
        # A bias of all keys moves no attention: its gradient is zero, and noise is in the file.
        floor = np.maximum(data["grad_l2"], 1e-6 * data["grad_l2"].max())
        off = largest_difference(norms / floor, data["grad_l2"] / floor)
        yield Row(name, f"{tag}gradient norms (relative)", off, norm)
        off = largest_difference(dots, data["grad_dot"]) / np.abs(data["grad_dot"]).max()
        yield Row(name, f"{tag}gradient products (of the largest)", off, dot)
