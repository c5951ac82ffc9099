"""Training steps as replayed CUDA graphs: equal to launched ones."""

import pytest
import torch
from model_cases import (
    build_small,
    disable_dropout,
    make_images,
    make_samples,
    small_config,
    straight_elements,
)

from gsmap.models.step_graphs import reason_against_recording

needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
TWO = straight_elements(((-5.0, -20.0), (-5.0, 20.0)), ((4.0, -10.0), (9.0, 15.0)), labels=[0, 2])
HEAD = {**small_config()["map_head"], "type": "GSMapHead", "masks": {"pixel_m": 1.5}}


def build(**settings):
    """A small GSMap in training mode, without dropout."""
    model = build_small(map_head=HEAD, **settings)
    return disable_dropout(model).train()


def losses_and_gradients(model, count=2, device="cpu"):
    """Losses of one batch, and all gradients as one vector."""
    torch.manual_seed(1)  # of the images and their augmentation
    images = {name: value.to(device) for name, value in make_images(count).items()}
    samples = [sample.to(device) for sample in make_samples(*[TWO] * count)]
    model.zero_grad()
    losses = model.loss(images, samples)
    model.parse_losses(losses)[0].backward()
    gradients = [p.grad.flatten() for p in model.parameters() if p.grad is not None]
    return losses, torch.cat(gradients).clone()


def check_equal(actual, expected, rtol):
    (losses, gradients), (expected_losses, expected_gradients) = actual, expected
    assert losses.keys() == expected_losses.keys()
    for name, loss in losses.items():
        torch.testing.assert_close(loss, expected_losses[name], rtol=rtol, atol=1e-6, msg=name)
    assert (gradients - expected_gradients).norm() < 10 * rtol * expected_gradients.norm()


def test_steps_from_tensors_equal_usual_ones():
    """On a CPU nothing is recorded, but inputs and outputs go the same way."""
    recorded, launched = build(cuda_graphs=True), build()
    assert list(recorded.state_dict()) == list(launched.state_dict())
    expected = losses_and_gradients(launched)
    check_equal(losses_and_gradients(recorded), expected, rtol=1e-5)


def test_auxiliary_losses_read_the_outputs_of_the_encoder():
    head = {**HEAD, "aux_heads": [{"type": "BEVMaskHead"}]}
    recorded = build_small(map_head=head, cuda_graphs=True).train()
    samples = make_samples(TWO)
    cells = recorded.bev_encoder.grid
    samples[0].gt_seg = torch.ones(1, cells.height, cells.width)
    losses = recorded.loss(make_images(1), samples)
    losses["loss_seg"].backward()
    assert any(p.grad is not None for p in recorded.img_backbone.parameters())


def test_predictions_do_not_change():
    torch.manual_seed(0)
    images = make_images(1)
    points = []
    for settings in ({}, {"cuda_graphs": True}):
        with torch.no_grad():
            samples = build(**settings).eval().predict(images, make_samples(TWO))
        points.append(samples[0].pred_instances_3d.pts)
    assert torch.equal(*points)


def test_models_whose_steps_cannot_be_recorded_are_named():
    assert reason_against_recording(build()) == ""
    with pytest.raises(ValueError, match=r"cuda_graphs=True .* compiled.*: use one of the two"):
        build(cuda_graphs=True, compiled=True)
    with pytest.raises(ValueError, match=r"cuda_graphs=True .* remembers earlier frames"):
        build(cuda_graphs=True, temporal={"bev": {}})
    model = torch.nn.SyncBatchNorm.convert_sync_batchnorm(build(cuda_graphs=True))
    with pytest.raises(ValueError, match=r"cuda_graphs=True .* wait for other processes \(SyncBN"):
        model.loss(make_images(1), make_samples(TWO))


def test_autocast_around_the_model_is_refused():
    """A recorded step would read weights that were cast once, at its recording."""
    model = build(cuda_graphs=True)
    with (
        torch.autocast("cpu", torch.bfloat16),
        pytest.raises(ValueError, match=r"--amp: leave it out, and set model.autocast=bfloat16"),
    ):
        model.loss(make_images(1), make_samples(TWO))


@needs_gpu
@pytest.mark.parametrize("autocast", [None, "bfloat16"])
def test_recorded_steps_equal_launched_ones(autocast):
    recorded = build(cuda_graphs=True, autocast=autocast).cuda()
    launched = build(autocast=autocast).cuda()
    rtol = 1e-4 if autocast is None else 0.02
    for count in (2, 2, 1, 2):  # sizes change, and weights below
        expected = losses_and_gradients(launched, count, "cuda")
        check_equal(losses_and_gradients(recorded, count, "cuda"), expected, rtol=rtol)
        for model in (recorded, launched):
            with torch.no_grad():
                for parameter in model.parameters():
                    parameter.mul_(0.99)
    for (name, ours), theirs in zip(recorded.named_buffers(), launched.buffers(), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=rtol, atol=1e-5, msg=name)
    assert len(recorded.step_graphs._recordings) == 2


@needs_gpu
def test_accumulated_gradients_are_refused():
    model = build(cuda_graphs=True).cuda()
    losses_and_gradients(model, device="cuda")
    images = {name: value.cuda() for name, value in make_images(2).items()}
    with pytest.raises(ValueError, match="accumulative_counts=1"):
        model.loss(images, [sample.to("cuda") for sample in make_samples(TWO, TWO)])


@needs_gpu
def test_random_numbers_do_not_depend_on_the_recording():
    model = build_small(map_head=HEAD, cuda_graphs=True).train().cuda()  # with dropout
    torch.manual_seed(3)
    first = losses_and_gradients(model, device="cuda")[1]
    second = losses_and_gradients(model, device="cuda")[1]  # the same seed, replayed
    torch.testing.assert_close(first, second, rtol=1e-3, atol=1e-5)
