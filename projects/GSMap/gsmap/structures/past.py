"""Temporal memory of a batch: tensors of the previous frames, and the motion since then.

Each sample of a batch is the current frame of a stream, a sequence of frames of one drive.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Past:
    """Memory of the previous frames, and the motion of the vehicle since then.

    Args:
        memory: Tensors by name that the model computed in the previous frames, without gradient.
            The values of a stream that starts are zeros. If all streams start, there are no
            tensors. (B, ...) each
        now_from_then: Transform from the previous to the current frame in metres; the identity for
            a stream that starts. (B, 4, 4)
        seconds: Time since the previous frame in seconds; 0 for a stream that starts. (B,)
        continues: Whether a stream has a previous frame, bool. (B,)
    """

    memory: Mapping[str, Tensor]
    now_from_then: Tensor
    seconds: Tensor
    continues: Tensor

    @property
    def then_from_now(self) -> Tensor:
        """Transform from the current to the previous frame in metres. (B, 4, 4)"""
        # The inverse of x -> R x + t is x -> R^T x - R^T t.
        rotation = self.now_from_then[:, :3, :3].transpose(1, 2)
        shift = -rotation @ self.now_from_then[:, :3, 3:]
        upper_rows = torch.cat([rotation, shift], dim=2)
        last_row = self.now_from_then[:, 3:]
        return torch.cat([upper_rows, last_row], dim=1)
