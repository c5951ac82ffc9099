"""Points whose embeddings their instance makes, by the setting that MGMap adds to every head."""

import pytest
import torch
from head_cases import GSMAP, HEAD, C, N, P, build_head

from gsmap.models.mgmap.queries import PointsOfInstances


def test_embeddings_of_points_by_hand():
    queries = PointsOfInstances(num_points=2, embed_dims=1)
    with torch.no_grad():
        queries.weight.copy_(torch.tensor([[1.0, 0.0], [0.0, 1.0], [2.0, 0.0], [0.0, 0.0]]))
        queries.bias.copy_(torch.tensor([0.0, 0.0, 0.0, 7.0]))
    points = queries(torch.tensor([[3.0, 5.0]]))  # the instance itself is added to each
    assert points.tolist() == [[[6.0, 10.0], [9.0, 12.0]]]


@pytest.mark.parametrize("config", [HEAD, GSMAP], ids=["MapHead", "GSMapHead"])
def test_every_head_has_the_setting_and_one_key_for_the_embeddings(config):
    head = build_head(config, points_from_instances=True)
    assert tuple(head.state_dict()["pts_embedding.weight"].shape) == (P * 2 * C, 2 * C)
    table = build_head(config, points_from_instances=False)
    assert tuple(table.state_dict()["pts_embedding.weight"].shape) == (P, 2 * C)
    for built in (head, table):
        position, content = built.eval().queries()
        assert position.shape == content.shape == (N * P, C)


def test_a_setting_that_no_method_adds_is_refused():
    with pytest.raises(TypeError, match="unexpected keyword argument 'points_from_instance'"):
        build_head(HEAD, points_from_instance=True)
