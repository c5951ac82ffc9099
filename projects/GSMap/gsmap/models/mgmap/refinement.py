"""MGMap's refinement: a patch of a mask feature around each point corrects its state."""

from typing import Any

import torch
from mmdet.models.backbones.resnet import BasicBlock
from mmengine.model import BaseModule
from torch import Tensor, nn

from gsmap.ops.deformable_sampling import deformable_sample
from gsmap.structures.tensors import constant

BINS, SAMPLES = 5, 2  # bins of a patch and samples of a bin along each axis
_BOX = 0.1  # side of a patch, of the map's side


def patches_around(feats: Tensor, centres: Tensor) -> Tensor:
    """Cut patches of a tenth of the map's sides out of it, bilinearly (RoI-align).

    As RoI-align does without its half-cell shift: values lie at whole numbers, and samples more
    than a cell outside count as zero. Maps (B, C, H, W), centres (x, y) in [0, 1] over them
    (B, Q, 2). -> (B, Q, C, 5, 5)
    """
    height, width = feats.shape[2:]
    size = constant(centres, [width, height])
    steps = (torch.arange(BINS * SAMPLES, device=feats.device) + 0.5) / (BINS * SAMPLES)
    grid = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), -1)  # (10, 10, 2)
    corners = (centres.clamp(max=1.0) - _BOX / 2) * size
    places = corners[:, :, None, None] + grid * (_BOX * size).clamp(min=1.0)
    places = places.unflatten(3, (BINS, SAMPLES)).unflatten(2, (BINS, SAMPLES))
    places = places.transpose(3, 4).flatten(4, 5).flatten(1, 3)[:, :, None]  # (B, Q * 25, 1, 4, 2)
    inside = ((places >= -1) & (places <= size)).all(-1)
    locations = (places.clamp(min=0.0).minimum(size - 1) + 0.5) / size
    values = feats.float().flatten(2).transpose(1, 2)[:, :, None]  # (B, cells, 1, C)
    seen = deformable_sample(values, (height, width), locations, inside / SAMPLES**2)
    return seen.unflatten(1, (-1, BINS, BINS)).movedim(-1, 2)


class MaskFeature(nn.Module):
    """BEV features with what a segmentation and the place of each cell say of them."""

    def __init__(self, embed_dims: int, hidden: int = 32) -> None:
        super().__init__()
        self.expand = nn.Conv2d(2, hidden, 3, padding=1)
        self.block = BasicBlock(hidden, hidden)
        self.reduce = nn.Conv2d(embed_dims + hidden + 2, embed_dims, 1)

    def forward(self, feats: Tensor, segmentation: Tensor) -> Tensor:
        """Join features (B, C, H, W) and logits (B, 2, H, W). -> (B, C, H, W)"""
        y, x = (
            ((torch.arange(side, device=feats.device) + 0.5) / side - 0.5).abs()
            for side in feats.shape[2:]
        )
        place = torch.stack(torch.meshgrid(x, y, indexing="xy"))  # (2, H, W)
        mask = self.block(self.expand(segmentation.softmax(1)))
        return self.reduce(torch.cat([feats, mask, place.expand(len(feats), -1, -1, -1)], 1))


class _HalfAttention(nn.TransformerDecoderLayer):
    """A decoder layer that adds half of what both of its attentions return."""

    def _sa_block(self, *args: Any, **kwargs: Any) -> Tensor:
        return 0.5 * super()._sa_block(*args, **kwargs)

    def _mha_block(self, *args: Any, **kwargs: Any) -> Tensor:
        return 0.5 * super()._mha_block(*args, **kwargs)


class PatchRefinement(BaseModule):
    """One stage of the refinement (MGMap), which starts from states of ``state_dims`` channels."""

    def __init__(
        self, embed_dims: int, state_dims: int, num_heads: int, ffn_dims: int, dropout: float
    ) -> None:
        super().__init__()
        self.patch_net = nn.Sequential(
            nn.Conv2d(embed_dims, embed_dims, BINS, groups=4),
            nn.Flatten(),
            nn.LayerNorm(embed_dims),
            nn.ReLU(),
            nn.Linear(embed_dims, embed_dims),
            nn.LayerNorm(embed_dims),
        )
        self.memory = nn.Sequential(
            nn.Linear(state_dims, embed_dims, bias=False), nn.LayerNorm(embed_dims)
        )
        self.layer = _HalfAttention(embed_dims, num_heads, ffn_dims, dropout, batch_first=True)
        self.norm = nn.LayerNorm(embed_dims)
        self.fuser = nn.Sequential(
            nn.Linear(state_dims + embed_dims, embed_dims, bias=False), nn.LayerNorm(embed_dims)
        )

    def init_weights(self) -> None:
        """Initialise as released: normal matrices without biases around the layer."""
        for part in (*self.patch_net, *self.memory, *self.fuser):
            if isinstance(part, (nn.Conv2d, nn.Linear)):
                nn.init.xavier_normal_(part.weight)
                if part.bias is not None:
                    nn.init.zeros_(part.bias)

    def forward(
        self, states: Tensor, patches: Tensor, mask: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return corrected states, and what they saw. (B, Q, state_dims) -> 2 x (B, Q, C)

        Patches are around the points (B, Q, C, 5, 5), or one for all (1, 1, C, 5, 5); the mask is
        True where a point may not attend to another (Q, Q).
        """
        seen = self.patch_net(patches.flatten(0, 1)).unflatten(0, patches.shape[:2])
        seen = seen.expand(*states.shape[:2], -1)
        memory = self.memory(states)
        seen = self.norm(self.layer(seen, memory, tgt_mask=mask, memory_mask=mask))
        return self.fuser(torch.cat([states.detach(), seen], -1)), seen


def mask_network(embed_dims: int, masks: int, activation: nn.Module) -> nn.Sequential:
    """Return a 3x3 convolution with BatchNorm and a 1x1. (B, C, H, W) -> (B, masks, H, W)

    Args:
        embed_dims: C.
        masks: Number of masks.
        activation: What stands between the two.
    """
    hidden = embed_dims // 2
    return nn.Sequential(
        nn.Conv2d(embed_dims, hidden, 3, padding=1, bias=False),
        nn.BatchNorm2d(hidden),
        activation,
        nn.Conv2d(hidden, masks, 1),
    )
