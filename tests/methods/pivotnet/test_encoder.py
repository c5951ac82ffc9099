"""PivotNet's encoder: which camera a cell looks at, and images that do not fit."""

import pytest
import torch

from gsmap.models.pivotnet.encoder import PivotBEVEncoder
from gsmap.structures.grid import BEVGrid

SIZE = (8, 16)


def encoder(**settings) -> PivotBEVEncoder:
    """Return an encoder of one BEV cell, whose centre lies at (0, 2)."""
    layers = {"num_heads": 2, "num_points": 2, "ffn_dims": 8}
    images = {"image_size": SIZE, "in_channels": (4,), "strides": (8,), "num_cams": 2}
    own = {**images, "bev_pixel_m": 4.0, "embed_dims": 8, "num_layers": (1, 2), **settings}
    return PivotBEVEncoder(BEVGrid((-2, 2), (0, 4)), layer_cfg=layers, **own).eval()


def cameras() -> torch.Tensor:
    """Return two cameras that look along y from (0, -2, 1) and (3, -8, 1). (1, 2, 4, 4)"""
    matrix = torch.tensor([[10.0, 8, 0, 0], [0, 4, -10, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    shifts = torch.eye(4).repeat(2, 1, 1)
    shifts[:, :3, 3] = torch.tensor([[0.0, 2, -1], [-3, 8, -1]])
    return (matrix @ shifts)[None]


@pytest.mark.parametrize(
    ("camera_by", "u", "v"),
    [("depth", (1 + 5 / 16) / 2, 5 / 8), ("angle", (0 + 8 / 16) / 2, 6.5 / 8)],
)
def test_a_cell_looks_at_the_deepest_or_the_straightest_camera(camera_by, u, v):
    uv, seen = encoder(camera_by=camera_by).project(cameras(), SIZE)
    assert seen.tolist() == [[True]]
    assert uv[0, 0].tolist() == pytest.approx([u, v])


def test_a_batch_gives_what_its_samples_give_alone():
    built, feats = encoder(), [torch.randn(2, 2, 4, 1, 2)]
    matrices = {"img_from_ground": torch.cat([cameras(), cameras().flip(1)])}
    both = built.encode(feats, matrices, SIZE)
    assert [level.shape for level in both["bev_levels"]] == [(2, 8, 1, 1)] * 2
    for i in range(2):
        own = {"img_from_ground": matrices["img_from_ground"][i : i + 1]}
        alone = built.encode([feats[0][i : i + 1]], own, SIZE)
        torch.testing.assert_close(alone["bev_feats"][0], both["bev_feats"][i])


def test_images_and_settings_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="camera_by must be 'depth' or 'angle', got 'near'"):
        encoder(camera_by="near")
    with pytest.raises(
        ValueError, match=r"must have \[\(1, 4\)\] feature pixels, not \[\(1, 6\)\]"
    ):
        encoder().encode([torch.randn(1, 2, 4, 1, 3)], {"img_from_ground": cameras()}, SIZE)
