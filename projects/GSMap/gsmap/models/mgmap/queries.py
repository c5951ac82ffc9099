"""MGMap's queries: an instance makes the embeddings of its points."""

from mmdet3d.registry import MODELS
from torch import Tensor, nn

from gsmap.models.base.parts import PARTS
from gsmap.models.base.queries import head_setting


@MODELS.register_module()
class PointsOfInstances(nn.Linear):
    """Embeddings of points that a matrix makes of their instance's embedding (MGMap).

    Args:
        num_points: Points per instance P.
        embed_dims: Channels C of a query; an embedding has twice as many.
    """

    def __init__(self, num_points: int, embed_dims: int) -> None:
        super().__init__(2 * embed_dims, num_points * 2 * embed_dims)
        self.num_points = num_points

    def forward(self, instances: Tensor) -> Tensor:
        """Return the embeddings of the points of instances. (N, 2 C) -> (N, P, 2 C)"""
        points = super().forward(instances).unflatten(1, (self.num_points, -1))
        return instances[:, None] + points


@head_setting("points_from_instances")
def points_from_instances(value: bool) -> PARTS:
    """Return the settings of a head whose instances make the embeddings of their points.

    Args:
        value: Whether they do.
    """
    return {"point_queries": {"type": PointsOfInstances}} if value else {}
