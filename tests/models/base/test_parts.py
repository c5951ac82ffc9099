"""What a head refuses when it is built: parts that do not find what they read."""

import pytest
from head_cases import GSMAP, HEAD, MASKS, N, build_head, with_layer
from mmdet3d.registry import MODELS
from torch import nn

from gsmap.models.base.losses import MapLoss

RASTER = {"type": "RasterLoss"}


@MODELS.register_module()
class OldLoss(nn.Module):
    """A loss that is no `MapLoss`."""

    name = "old"


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"losses": [*HEAD["losses"], RASTER]},
            r"RasterLoss needs Gaussians, got PointReference: set .*type='GaussianReference'",
        ),
        (
            {"match_costs": [*HEAD["match_costs"], {"type": "IoUCost"}]},
            r"IoUCost needs Gaussians, got PointReference",
        ),
        ({"losses": [{"type": "OldLoss"}]}, r"OldLoss is no MapLoss: derive it from .*MapLoss"),
        ({"losses": [{"type": MapLoss}]}, "MapLoss needs a name: a class attribute `name`"),
        ({"losses": [HEAD["losses"][0]] * 2}, "two parts have one name, 'pts'"),
        (
            {"aux_heads": [{"type": "BEVMaskHead", "name": "pts"}]},
            r"two losses have one name, 'pts'; there are \['cls', 'pts', 'dir', 'pts'\]",
        ),
        ({"aux_heads": [{"type": "BEVMaskHead"}] * 2}, "two parts have one name, 'seg'"),
        (
            {"query_groups": [{"num": N}, {"num": 6, "name": "more", "losses": ("raster",)}]},
            r"query group 'more' names losses \['raster'\]; there are \['cls', 'pts', 'dir'\]",
        ),
        ({"query_groups": [{"num": N}, {"num": 6}]}, "two query groups have one name, ''"),
        ({"query_groups": [{"num": N, "repeats": 0}]}, "num >= 1 and repeats >= 1, got 4 and 0"),
        ({"match_costs": []}, "at least one cost"),
        (
            {"decoder": with_layer(HEAD, type="GaussianDecoderLayer")},
            "guided decoder layer needs a reference that holds Gaussians",
        ),
        ({"reference": {"coords": 3}}, "coords must be 2, or 3 with a z_range"),
    ],
)
def test_a_part_that_misses_something_is_refused_by_name(settings, message):
    with pytest.raises((TypeError, ValueError), match=message):
        build_head(HEAD, **settings)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"losses": [RASTER]}, "two parts have one name, 'raster'"),  # and the default one
        ({"reference": {"type": "PointReference", "min_scale_m": 0.2}}, "min_scale_m"),
        ({"masks": {**MASKS, "source": "half"}}, "source must be one of .*, got 'half'"),
    ],
)
def test_gsmap_refuses_as_well(settings, message):
    with pytest.raises((TypeError, ValueError), match=message):
        build_head(GSMAP, **settings)


def test_a_loss_of_masks_works_under_any_head_whose_reference_is_a_gaussian():
    head = build_head(
        HEAD,
        reference={"type": "GaussianReference"},
        losses=[*HEAD["losses"], RASTER],
        masks=MASKS,
    )
    assert list(head.losses) == ["pts", "dir", "raster"]
