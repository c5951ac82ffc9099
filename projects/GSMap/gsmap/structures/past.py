"""Temporal memory of a batch: tensors of the previous frames, and the motion since then."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Past:
    """Memory of the previous frames, and the motion of the vehicle since then.

    Args:
        memory: Tensors by name, without gradient; zeros for a stream that starts, and empty if all
            streams start. (B, ...) each
        now_from_then: Transform from the previous to the current frame in metres; the identity for
            a stream that starts. (B, 4, 4)
        seconds: Time since the previous frame in seconds. (B,)
        continues: Whether a stream continues, bool. (B,)
    """

    memory: Mapping[str, Tensor]
    now_from_then: Tensor
    seconds: Tensor
    continues: Tensor

    @property
    def then_from_now(self) -> Tensor:
        """Transform from the current to the previous frame in metres. (B, 4, 4)"""
        rotation = self.now_from_then[:, :3, :3].transpose(1, 2)
        shift = -rotation @ self.now_from_then[:, :3, 3:]
        upper_rows = torch.cat([rotation, shift], dim=2)
        last_row = self.now_from_then[:, 3:]
        return torch.cat([upper_rows, last_row], dim=1)
