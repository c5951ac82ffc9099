import pytest
import torch

pytest.importorskip("mmdet3d")

from gsmap.models.encoders.vovnet import OneShotAggregation, VoVNet


def test_v2_99_has_the_published_size_and_the_originals_names():
    """timm lists 63.2 M, of which 1.025 M classify; it gates each stage's last block alone."""
    state = VoVNet(99).state_dict()
    last = ("OSA2_1", "OSA3_3", "OSA4_9", "OSA5_3")
    sizes = {
        key: value.numel()
        for key, value in state.items()
        if not key.endswith(("running_mean", "running_var", "num_batches_tracked"))
        and ("ese" not in key or key.split(".")[1] in last)
    }
    assert sum(sizes.values()) == pytest.approx(63.2e6 - 1.025e6, abs=1e5)
    assert state["stem.stem_3/conv.weight"].shape == (128, 64, 3, 3)
    assert state["stage2.OSA2_1.layers.0.OSA2_1_0/conv.weight"].shape == (128, 128, 3, 3)
    assert state["stage4.OSA4_9.concat.OSA4_9_concat/norm.running_var"].shape == (768,)
    assert state["stage5.OSA5_3.ese.fc.bias"].shape == (1024,)
    assert "stage4.OSA4_1.ese.fc.bias" in state
    assert "stage4.OSA4_10.ese.fc.bias" not in state


def test_stages_halve_an_odd_image_and_its_rests():
    model = VoVNet(19, out_indices=(0, 1, 2, 3)).eval()
    with torch.no_grad():
        shapes = [tuple(feats.shape[1:]) for feats in model(torch.rand(1, 3, 65, 96))]
    assert shapes == [(256, 17, 24), (512, 8, 12), (768, 4, 6), (1024, 2, 3)]


def test_block_aggregates_its_input_and_every_layer_and_gates_channels():
    """The gates are hard sigmoids of 3, 0 and -3: 1, 1/2 and 0."""
    block = OneShotAggregation("b", (3, 2, 3), num_layers=2, residual=True).eval()
    block.ese.fc.weight.data.zero_()
    block.ese.fc.bias.data = torch.tensor([3.0, 0.0, -3.0])
    feats = torch.rand(1, 3, 5, 5)
    first = block.layers[0](feats)
    parts = block.concat(torch.cat([feats, first, block.layers[1](first)], 1))
    expected = feats + parts * torch.tensor([1.0, 0.5, 0.0])[:, None, None]
    torch.testing.assert_close(block(feats), expected)


def test_frozen_parts_stay_frozen_in_training():
    model = VoVNet(19, frozen_stages=1)
    for _ in range(2):  # also before the first `train`, when optimizers collect weights
        trained = {name.split(".")[0] for name, p in model.named_parameters() if p.requires_grad}
        assert trained == {"stage3", "stage4", "stage5"}
        model.train()
    assert not any(m.training for m in model.modules() if isinstance(m, torch.nn.BatchNorm2d))
    assert all(p.requires_grad for p in VoVNet(19).train().parameters())


def test_fixed_statistics_stay_fixed_in_sync_bn():
    model = VoVNet(19, norm_eval=True, frozen_stages=-1)
    model = torch.nn.SyncBatchNorm.convert_sync_batchnorm(model).train()
    norms = [m for m in model.modules() if isinstance(m, torch.nn.SyncBatchNorm)]
    assert norms
    assert not any(norm.training for norm in norms)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"depth": 18}, "depth must be one of .*, got 18"),
        ({"out_indices": (4,)}, r"out_indices must lie in 0 to 3 .* got \(4,\)"),
        ({"frozen_stages": 5}, "frozen_stages in -1 to 4, got .* 5"),
    ],
)
def test_bad_arguments_are_named(change, match):
    with pytest.raises(ValueError, match=match):
        VoVNet(**{"depth": 19, **change})
