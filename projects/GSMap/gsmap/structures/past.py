"""What the streams of a batch have left."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Past:
    """What the streams of a batch have left, and how the vehicle has moved since.

    Args:
        memory: It, by name, without gradient; zeros where a stream starts, nothing if all do.
            (B, ...) each
        now_from_then: Takes metres then to metres now, the identity where a stream starts.
            (B, 4, 4)
        seconds: The time since then. (B,)
        continues: Which streams continue. (B,)
    """

    memory: Mapping[str, Tensor]
    now_from_then: Tensor
    seconds: Tensor
    continues: Tensor

    @property
    def then_from_now(self) -> Tensor:
        """What takes metres now to metres then. (B, 4, 4)"""
        turn = self.now_from_then[:, :3, :3].transpose(1, 2)
        shift = -turn @ self.now_from_then[:, :3, 3:]
        return torch.cat([torch.cat([turn, shift], 2), self.now_from_then[:, 3:]], 1)
