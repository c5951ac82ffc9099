"""Parts of GSMap as its paper or release prints them; paper.json has further numbers."""

from paper_cases import head_of


def test_gsmap_renders_and_weighs_as_in_its_paper():
    """Section 4.1: rasters of 200 x 100; Eq. 12 with 3DGS's weights and SSIM's usual window."""
    head = head_of("projects/GSMap/configs/gsmap_maptr_r50_24e.py")
    assert (head.masks.grid.height, head.masks.grid.width) == (200, 100)
    assert head.losses["raster"].settings == {
        "alpha": 0.8,
        "foreground_weight": 1.0,
        "normalize": "both",
        "window_size": 11,
        "window_sigma": 1.5,
    }
    assert not head.losses["raster"].last_layer_only
    space = head.reference.space
    assert (space.min_scale_m, space.init_scales_m) == (0.15, (1.0, 0.4))  # half a pixel, and ours
