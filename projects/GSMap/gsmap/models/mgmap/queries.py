"""MGMap's queries, whose point embeddings are computed from instance embeddings."""

from mmdet3d.registry import MODELS
from torch import Tensor, nn

from gsmap.models.base.parts import PartConfig
from gsmap.models.base.queries import head_setting


@MODELS.register_module()
class PointsOfInstances(nn.Linear):
    """Linear layer that computes point embeddings from the embedding of their instance (MGMap).

    Args:
        num_points: Points per instance P.
        embed_dims: Channels C of a query. An embedding has 2 C channels: C for the state and C for
            the positional encoding of the query.
    """

    def __init__(self, num_points: int, embed_dims: int) -> None:
        super().__init__(2 * embed_dims, num_points * 2 * embed_dims)
        self.num_points = num_points

    def forward(self, instances: Tensor) -> Tensor:
        """Compute the embeddings of the points of instances. (N, 2 C) -> (N, P, 2 C)"""
        point_terms = super().forward(instances).unflatten(1, (self.num_points, -1))
        return instances[:, None] + point_terms  # each point also has the embedding of its instance


# The decorator adds the setting `points_from_instances` to `MapHead`. If a config has it, the head
# calls this function and uses the returned settings in its place.
@head_setting("points_from_instances")
def points_from_instances(value: bool) -> PartConfig:
    """Return the settings of a head with `PointsOfInstances`.

    Args:
        value: Whether the head computes point embeddings from instance embeddings.

    Returns:
        Settings of `MapHead`; empty if ``value`` is False.
    """
    return {"point_queries": {"type": PointsOfInstances}} if value else {}
