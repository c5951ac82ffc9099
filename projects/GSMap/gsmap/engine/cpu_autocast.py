"""Mixed precision on a CPU, which mmengine's ``AmpOptimWrapper`` does not support."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from mmengine.registry import OPTIM_WRAPPERS
from torch import nn

from gsmap.engine.optimizers import MapOptimWrapper


@OPTIM_WRAPPERS.register_module()
class CPUAutocastOptimWrapper(MapOptimWrapper):
    """Runs forward pass and losses under bfloat16 autocast on a CPU; weights stay float32.

    bfloat16 has the exponent range of float32, so the loss needs no scaling. Parts that need
    float32 (reference points, matching, losses, rendering) disable autocast, as on a GPU.
    """

    @contextmanager
    def optim_context(self, model: nn.Module) -> Iterator[None]:
        """Enter autocast and the context of ``OptimWrapper`` that accumulates gradients."""
        with super().optim_context(model), torch.autocast("cpu", dtype=torch.bfloat16):
            yield
