"""Soft rasters of lines and polygons equal those of the released code."""

import numpy as np
import pytest
import torch

from gsmap.ops.polyline_raster import soft_rasters

BACKENDS = ["reference", "cpu"]


@pytest.mark.parametrize("backend", BACKENDS)
def test_soft_rasters_equal_the_golden_ones(golden_dir, backend):
    golden = np.load(golden_dir / "models/mapvr_rasters_A.npz")
    kinds = {f"line{i}_lane_boundary_s2": False for i in range(4)}
    for i in range(4):
        kinds |= {f"poly{i}_mask_s4": True, f"poly{i}_as_lane_s2": False}
    for name, is_polygon in kinds.items():
        vertices = torch.from_numpy(golden[f"{name.split('_')[0]}_vertices"])[None]
        mask = soft_rasters(vertices, 64, 32, torch.tensor([is_polygon]), backend=backend)[0]
        torch.testing.assert_close(mask, torch.from_numpy(golden[name]), atol=1e-5, rtol=0)


@pytest.mark.parametrize("backend", BACKENDS)
def test_plain_distance_equals_the_golden_rasters_roots(golden_dir, backend):
    """A golden mask holds its squared distance wherever float32 does not round it away."""
    golden = np.load(golden_dir / "models/mapvr_rasters_A.npz")
    kinds = {f"line{i}_lane_boundary_s2": False for i in range(4)}
    kinds |= {f"poly{i}_mask_s4": True for i in range(4)}
    for name, is_polygon in kinds.items():
        vertices = torch.from_numpy(golden[f"{name.split('_')[0]}_vertices"])[None]
        squared = torch.from_numpy(golden[name]).double()
        squared = 4 * torch.logit(squared) if is_polygon else -2 * squared.log()
        clear = (squared.abs() > 1e-2) & (squared.abs() < 25)
        distance = squared.abs().sqrt()
        expected = (
            torch.sigmoid(squared.sign() * distance / 4) if is_polygon else (-distance / 2).exp()
        )
        mask = soft_rasters(
            vertices, 64, 32, torch.tensor([is_polygon]), distance="plain", backend=backend
        )
        assert clear.sum() > 100
        torch.testing.assert_close(mask[0][clear], expected[clear].float(), atol=1e-5, rtol=0)
