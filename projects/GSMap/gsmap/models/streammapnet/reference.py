"""StreamMapNet's reference: a whole line per instance query, predicted anew by each layer."""

from collections.abc import Sequence

from mmdet3d.registry import MODELS
from torch import Tensor, nn

from gsmap.models.maptr.references import PointReference
from gsmap.structures.grid import BEVGrid
from gsmap.structures.tensors import in_float32


@MODELS.register_module()
class LineReference(PointReference):
    """The points of a line, [0, 1] over the map, which each layer predicts absolutely.

    All layers share one branch, and nothing is added to the line before. Besides `PointReference`'s
    arguments:

    Args:
        num_points: Points per instance P.
    """

    def __init__(
        self,
        grid: BEVGrid,
        embed_dims: int = 512,
        num_layers: int = 6,
        num_points: int = 20,
        coords: int = 2,
        z_range: Sequence[float] | None = None,
        points_per_state: int = 1,
    ) -> None:
        super().__init__(grid, 1, 0, coords, z_range, points_per_state)
        self.initial = nn.Linear(embed_dims, num_points * coords)
        layers: list[nn.Module] = []
        dims = embed_dims
        for _ in range(2):
            layers += [nn.Linear(dims, 2 * embed_dims), nn.LayerNorm(2 * embed_dims), nn.ReLU()]
            dims = 2 * embed_dims
        branch = nn.Sequential(*layers, nn.Linear(dims, num_points * coords))
        self.branches = nn.ModuleList([branch] * num_layers)

    def init_weights(self) -> None:
        """Spread the first lines over the map; matrices of the branch are Xavier's."""
        super().init_weights()
        for parameter in self.branches.parameters():
            if parameter.dim() > 1:
                nn.init.xavier_uniform_(parameter)

    def refine(self, layer: int, point_states: Tensor, reference: Tensor) -> Tensor:
        """Return the lines after a layer. (B, N, C), (B, N * P, D) -> (B, N * P, D)"""
        lines = in_float32(self.branches[layer], point_states).sigmoid()
        return lines.unflatten(-1, (-1, self.coords)).flatten(1, 2)
