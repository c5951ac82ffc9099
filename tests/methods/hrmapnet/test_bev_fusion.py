"""Fusion of the BEV features with the map."""

import torch

from gsmap.models.hrmapnet.bev_fusion import PriorBEVFusion
from gsmap.structures.grid import BEVGrid

GRID = BEVGrid((-15, 15), (-30, 30), 4, 2)


class Layer(torch.nn.Module):
    """A BEV layer whose output is 1 everywhere."""

    calibration = ("img_from_frame",)

    def encode(self, img_feats, calibration, img_shape):
        return {"bev_feats": torch.ones(len(img_feats), 8, 4, 2)}


def fuse(module, cells, feats):
    images = torch.zeros(len(feats), 1, 8, 2, 2)
    return module(feats, cells, img_feats=images, calibration={}, img_shape=(8, 8))


def fusion() -> PriorBEVFusion:
    torch.manual_seed(0)
    module = PriorBEVFusion(GRID, embed_dims=8, layer=None)
    module.init_weights()
    return module.eval()


def test_the_layer_counts_where_a_channel_reaches_the_threshold():
    module, feats = fusion(), torch.zeros(1, 8, 4, 2)
    module.layer = Layer()
    module.conv = torch.nn.Identity()
    cells = torch.zeros(1, 3, 4, 2)
    cells[0, 1, 2, 0] = 0.8
    cells[0, 2, 3, 1] = 0.79
    fused = fuse(module, cells, feats)
    assert fused.shape == (1, 8 + 3, 4, 2)
    known = fused[0, :8].amax(0)
    assert known.nonzero().tolist() == [[2, 0]]
    torch.testing.assert_close(fused[:, 8:], cells)


def test_the_map_is_appended_and_convolved():
    module = fusion()
    feats, cells = torch.randn(2, 8, 4, 2), torch.rand(2, 3, 4, 2)
    weight = module.conv[0].weight
    expected = torch.nn.functional.conv2d(torch.cat([feats, cells], 1), weight, padding=1).relu()
    torch.testing.assert_close(fuse(module, cells, feats), expected, atol=1e-4, rtol=1e-4)
    assert module.calibration == ()
    assert weight.shape == (8, 11, 3, 3)
