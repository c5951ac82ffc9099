"""StreamMapNet's reference: a line per instance query, which each layer predicts directly."""

from collections.abc import Sequence

from mmdet3d.registry import MODELS
from torch import Tensor, nn

from gsmap.models.maptr.references import PointReference
from gsmap.structures.grid import BEVGrid
from gsmap.structures.tensors import in_float32


@MODELS.register_module()
class LineReference(PointReference):
    """Points of a line in [0, 1] over the map, which each layer predicts directly.

    Layers do not predict offsets from the previous points. All layers share one prediction branch.

    Args:
        grid: Extent of the map, in metres.
        embed_dims: Channels C of the instance states.
        num_layers: Number of decoder layers.
        num_points: Points per instance P.
        coords: Coordinates D of a point: 2, or 3 for points with height.
        z_range: Lowest and highest z in metres, for points with height.
        points_per_state: Number of points that one query initialises, as in `PointReference`.
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
        # The networks of the base class are replaced below, so they are created as small as
        # possible.
        super().__init__(
            grid,
            embed_dims=1,
            num_layers=0,
            coords=coords,
            z_range=z_range,
            points_per_state=points_per_state,
        )
        # From a positional query to the first line, in `start` of the base class.
        self.initial = nn.Linear(embed_dims, num_points * coords)
        hidden_dims = 2 * embed_dims
        branch = nn.Sequential(
            nn.Linear(embed_dims, hidden_dims),
            nn.LayerNorm(hidden_dims),
            nn.ReLU(),
            nn.Linear(hidden_dims, hidden_dims),
            nn.LayerNorm(hidden_dims),
            nn.ReLU(),
            nn.Linear(hidden_dims, num_points * coords),
        )
        self.branches = nn.ModuleList([branch] * num_layers)  # one module for all layers

    def init_weights(self) -> None:
        """Initialise the first lines as in the base class, and the branch with Xavier's method."""
        super().init_weights()
        for parameter in self.branches.parameters():
            if parameter.dim() > 1:  # matrices; biases and layer norms keep their values
                nn.init.xavier_uniform_(parameter)

    def refine(self, layer: int, point_states: Tensor, reference: Tensor) -> Tensor:
        """Predict the lines of a layer.

        Args:
            layer: Index of the layer.
            point_states: States of the instances, one for all points of a line. (B, N, C)
            reference: References of the previous layer; unused. (B, N * P, D)

        Returns:
            References in [0, 1] over the map. (B, N * P, D)
        """
        # Without autocast: half precision has too few digits for neighbouring points.
        lines = in_float32(self.branches[layer], point_states).sigmoid()
        return lines.unflatten(-1, (-1, self.coords)).flatten(1, 2)
