"""BEV features at several resolutions."""

from torch import Tensor, nn

from gsmap.utils.errors import InputError


class PatchMerging(nn.Module):
    """Downsampling by two: joins the channels of 2 x 2 cells and projects them (MGMapNet).

    Args:
        embed_dims: Channels C.
    """

    def __init__(self, embed_dims: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(4 * embed_dims)
        self.reduction = nn.Linear(4 * embed_dims, embed_dims, bias=False)

    def forward(self, feats: Tensor) -> Tensor:
        """Halve the sides of a map. (B, C, H, W) -> (B, C, H / 2, W / 2)

        Raises:
            ValueError: If a side is odd.
        """
        height, width = feats.shape[-2:]
        if height % 2 or width % 2:
            raise InputError(f"a BEV level needs even sides to be halved, got {height} x {width}.")
        # Split each side into h = H / 2 or w = W / 2 pairs of cells.
        patches = feats.unflatten(3, (-1, 2)).unflatten(2, (-1, 2))  # (B, C, h, 2, w, 2)
        # Channel order of the released checkpoints: both rows of the even column, then both rows of
        # the odd column. mmdet's PatchMerging has another order.
        patches = patches.permute(0, 2, 4, 5, 3, 1).flatten(3)  # (B, h, w, 4 C)
        cells = self.reduction(self.norm(patches))  # (B, h, w, C)
        return cells.permute(0, 3, 1, 2)


class BEVPyramid(nn.Module):
    """Levels of BEV features, each with half the resolution of the previous one.

    Args:
        embed_dims: Channels C.
        num_levels: Number of levels, >= 1.

    Raises:
        ValueError: If ``num_levels`` is less than 1.
    """

    def __init__(self, embed_dims: int = 256, num_levels: int = 2) -> None:
        super().__init__()
        if num_levels < 1:
            raise InputError(f"num_levels must be >= 1, got {num_levels}.")
        self.merges = nn.ModuleList(PatchMerging(embed_dims) for _ in range(num_levels - 1))

    def forward(self, bev_feats: Tensor) -> list[Tensor]:
        """Compute all levels, the finest first. (B, C, H, W) -> (B, C, H / 2^l, W / 2^l) each

        Raises:
            ValueError: If a level that is to be halved has an odd side.
        """
        levels = [bev_feats]
        for merge in self.merges:
            levels.append(merge(levels[-1]))
        return levels
