"""MGMap's refinement, which corrects the states of points by features cropped around them.

The state of a point is its feature vector after the decoder.
"""

import torch
from mmdet.models.backbones.resnet import BasicBlock
from mmengine.model import BaseModule
from torch import Tensor, nn

from gsmap.ops.deformable_sampling import deformable_sample
from gsmap.structures.tensors import constant

BINS = 5  # bins (output cells) of a patch along each axis
SAMPLES = 2  # sampling points of a bin along each axis
_PATCH_SHARE = 0.1  # side of a patch divided by the side of the map


def crop_patches(feats: Tensor, centres: Tensor) -> Tensor:
    """Crop patches, whose sides are a tenth of the map's sides, by bilinear sampling (RoIAlign).

    As in RoIAlign with ``aligned=False``, values lie at integer positions, and sampling points more
    than a cell outside the map are 0.

    Args:
        feats: Features. (B, C, H, W)
        centres: Centres (x, y) of the patches in [0, 1] over the map; larger values count as 1.
            (B, Q, 2)

    Returns:
        Patches. (B, Q, C, 5, 5)
    """
    height, width = feats.shape[2:]
    size = constant(centres, [width, height])
    # Compute the sampling points in [0, 1] over a patch.
    steps = (torch.arange(BINS * SAMPLES, device=feats.device) + 0.5) / (BINS * SAMPLES)
    grid = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), dim=-1)  # (10, 10, 2)
    # Convert the sampling points to cells of the map. As in RoIAlign, a patch has at least the size
    # of a cell.
    corners = (centres.clamp(max=1.0) - _PATCH_SHARE / 2) * size
    patch_size = (_PATCH_SHARE * size).clamp(min=1.0)
    samples = corners[:, :, None, None] + grid * patch_size  # (B, Q, 10, 10, 2)
    # Group the sampling points by bin.
    samples = samples.unflatten(3, (BINS, SAMPLES))  # (B, Q, 10, 5, 2, 2)
    samples = samples.unflatten(2, (BINS, SAMPLES))  # (B, Q, 5, 2, 5, 2, 2)
    samples = samples.transpose(3, 4).flatten(4, 5)  # (B, Q, 5, 5, 4, 2)
    samples = samples.flatten(1, 3)[:, :, None]  # (B, Q * 25, 1, 4, 2)
    # Centres of cells are at 0 to size - 1, so -1 and `size` are one cell outside of the map.
    inside = ((samples >= -1) & (samples <= size)).all(dim=-1)
    samples_on_map = samples.clamp(min=0.0).minimum(size - 1)
    # `deformable_sample` has values at the centres of cells, half a cell from integer positions.
    locations = (samples_on_map + 0.5) / size
    values = feats.float().flatten(2).transpose(1, 2)  # (B, H * W, C)
    values = values[:, :, None]  # (B, H * W, 1, C)
    # A bin is the mean over its sampling points. Points outside the map count as 0.
    patches = deformable_sample(
        values, (height, width), locations=locations, weights=inside / SAMPLES**2
    )  # (B, Q * 25, C)
    return patches.unflatten(1, (-1, BINS, BINS)).movedim(-1, 2)


class MaskFeature(nn.Module):
    """Fusion of BEV features with a segmentation embedding and a positional encoding.

    Args:
        embed_dims: Channels C of the BEV features.
        hidden: Channels of the segmentation embedding, which is computed from the probabilities
            of elements and of background.
    """

    def __init__(self, embed_dims: int, hidden: int = 32) -> None:
        super().__init__()
        self.expand = nn.Conv2d(2, hidden, kernel_size=3, padding=1)
        self.block = BasicBlock(hidden, hidden)
        self.reduce = nn.Conv2d(embed_dims + hidden + 2, embed_dims, kernel_size=1)

    def forward(self, feats: Tensor, segmentation: Tensor) -> Tensor:
        """Fuse features and segmentation logits.

        Args:
            feats: BEV features. (B, C, H, W)
            segmentation: Logits of elements and of background. (B, 2, H, W)

        Returns:
            Fused features. (B, C, H, W)
        """
        height, width = feats.shape[2:]
        y = (torch.arange(height, device=feats.device) + 0.5) / height
        x = (torch.arange(width, device=feats.device) + 0.5) / width
        # The positional encoding is the distance to the centre of the map along each axis.
        y = (y - 0.5).abs()
        x = (x - 0.5).abs()
        position = torch.stack(torch.meshgrid(x, y, indexing="xy"))  # (2, H, W)
        position = position.expand(len(feats), -1, -1, -1)
        embedding = self.block(self.expand(segmentation.softmax(dim=1)))  # (B, hidden, H, W)
        return self.reduce(torch.cat([feats, embedding, position], dim=1))


class _HalfAttention(nn.TransformerDecoderLayer):
    """Decoder layer that halves the outputs of both attentions before they are added.

    The two attentions are self-attention (``_sa_block``) and attention to the memory
    (``_mha_block``). Each output is added to the input of its attention.

    It overrides private methods of PyTorch, which pass their arguments by position.
    """

    def _sa_block(
        self,
        x: Tensor,
        attn_mask: Tensor | None,
        key_padding_mask: Tensor | None,
        is_causal: bool = False,
    ) -> Tensor:
        return 0.5 * super()._sa_block(x, attn_mask, key_padding_mask, is_causal)

    def _mha_block(
        self,
        x: Tensor,
        mem: Tensor,
        attn_mask: Tensor | None,
        key_padding_mask: Tensor | None,
        is_causal: bool = False,
    ) -> Tensor:
        return 0.5 * super()._mha_block(x, mem, attn_mask, key_padding_mask, is_causal)


class PatchRefinement(BaseModule):
    """Refinement of point states by the patches around the points (MGMap).

    The features of the patches attend to one another and to the states. Then the states are fused
    with these features.

    Args:
        embed_dims: Channels C of the patches and of the corrected states.
        state_dims: Channels S of the input states. It may differ from C, because the caller appends
            the glimpses of earlier refinements to the states.
        num_heads: Number of attention heads.
        ffn_dims: Hidden channels of the feed-forward network.
        dropout: Probability of setting a value to zero in training, in [0, 1].
    """

    def __init__(
        self, embed_dims: int, state_dims: int, num_heads: int, ffn_dims: int, dropout: float
    ) -> None:
        super().__init__()
        self.patch_net = nn.Sequential(
            # The kernel covers the whole patch, so each patch becomes one vector.
            nn.Conv2d(embed_dims, embed_dims, kernel_size=BINS, groups=4),
            nn.Flatten(),
            nn.LayerNorm(embed_dims),
            nn.ReLU(),
            nn.Linear(embed_dims, embed_dims),
            nn.LayerNorm(embed_dims),
        )
        self.memory = nn.Sequential(
            nn.Linear(state_dims, embed_dims, bias=False), nn.LayerNorm(embed_dims)
        )
        self.layer = _HalfAttention(
            embed_dims, num_heads, dim_feedforward=ffn_dims, dropout=dropout, batch_first=True
        )
        self.norm = nn.LayerNorm(embed_dims)
        self.fuser = nn.Sequential(
            nn.Linear(state_dims + embed_dims, embed_dims, bias=False), nn.LayerNorm(embed_dims)
        )

    def init_weights(self) -> None:
        """Initialise the weights outside of the attention layer by Xavier's normal distribution.

        Their biases are set to 0.
        """
        for module in (*self.patch_net, *self.memory, *self.fuser):
            if isinstance(module, (nn.Conv2d, nn.Linear)):
                nn.init.xavier_normal_(module.weight)
                if module.bias is not None:
                    nn.init.zeros_(module.bias)

    def forward(
        self, states: Tensor, patches: Tensor, mask: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Correct the states of points.

        Args:
            states: States of the points. (B, Q, S)
            patches: Patches around the points (B, Q, C, 5, 5), or one patch that is used for all
                points (1, 1, C, 5, 5).
            mask: True where a point (row) does not attend to another point (column), in
                self-attention and in cross-attention. None for no mask. (Q, Q)

        Returns:
            Corrected states (B, Q, C), and glimpses: the features of the patches after attention.
            (B, Q, C)
        """
        glimpses = self.patch_net(patches.flatten(0, 1)).unflatten(0, patches.shape[:2])
        glimpses = glimpses.expand(states.shape[0], states.shape[1], -1)
        memory = self.memory(states)
        glimpses = self.norm(self.layer(glimpses, memory, tgt_mask=mask, memory_mask=mask))
        # `fuser` gets detached states, so the gradient reaches the input states only through the
        # memory of the attention.
        corrected_states = self.fuser(torch.cat([states.detach(), glimpses], dim=-1))
        return corrected_states, glimpses


def mask_network(embed_dims: int, masks: int, activation: nn.Module) -> nn.Sequential:
    """Create a network that predicts masks by a 3x3 convolution with BatchNorm and a 1x1 one.

    Args:
        embed_dims: Channels C of the input. (B, C, H, W)
        masks: Number of masks, the channels of the output. (B, masks, H, W)
        activation: Activation between both convolutions.
    """
    hidden = embed_dims // 2
    return nn.Sequential(
        nn.Conv2d(embed_dims, hidden, kernel_size=3, padding=1, bias=False),
        nn.BatchNorm2d(hidden),
        activation,
        nn.Conv2d(hidden, masks, kernel_size=1),
    )
