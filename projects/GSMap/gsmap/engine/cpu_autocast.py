"""Mixed precision on a CPU, which mmengine's ``AmpOptimWrapper`` refuses."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from mmengine.registry import OPTIM_WRAPPERS
from torch import nn

from gsmap.engine.optimizers import MapOptimWrapper


@OPTIM_WRAPPERS.register_module()
class CPUAutocastOptimWrapper(MapOptimWrapper):
    """Runs forward and losses under bfloat16 autocast of the CPU; weights stay float32.

    bfloat16 has the exponents of float32, so the loss needs no scale. Parts that need float32
    (references, matching, losses, rendering) leave autocast themselves, as on a GPU.
    """

    @contextmanager
    def optim_context(self, model: nn.Module) -> Iterator[None]:
        """Enter autocast, and what ``OptimWrapper`` enters to accumulate gradients."""
        with super().optim_context(model), torch.autocast("cpu", torch.bfloat16):
            yield
