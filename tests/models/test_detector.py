import pytest
import torch
from model_cases import build_small, make_images, make_samples, straight_elements
from predictions import stacked

NONE = straight_elements()
ONE = straight_elements(((-5.0, -20.0), (-5.0, 20.0)))
MANY = straight_elements(
    *(((-12.0 + 3 * i, -25.0), (-12.0 + 3 * i, 25.0 - i)) for i in range(8)),
    labels=[0, 1, 2, 0, 1, 2, 0, 1],
)


@pytest.mark.parametrize("gts", [(NONE,), (NONE, NONE), (ONE,), (NONE, MANY)])
def test_it_trains_with_no_one_and_many_elements(gts):
    torch.manual_seed(0)
    model = build_small().train()
    losses = model.loss(make_images(len(gts)), make_samples(*gts))
    names = {"loss_cls", "loss_pts", "loss_dir"}
    assert set(losses) == names | {f"d0.{name}" for name in names}
    total = torch.stack(list(losses.values())).sum()
    total.backward()
    without = [n for n, p in model.named_parameters() if p.requires_grad and p.grad is None]
    assert not without  # or distributed training would hang
    if not sum(len(gt) for gt in gts):
        assert losses["loss_pts"].item() == 0.0


def test_predictions_are_in_metres_best_first():
    torch.manual_seed(0)
    model = build_small().eval()
    with torch.no_grad():
        images, samples = make_images(2), make_samples(NONE, NONE)
        results = model.predict(images, samples)
        raw = model._forward(images, samples)
    for number, sample in enumerate(results):
        found = sample.pred_instances_3d
        assert found.pts.shape[1:] == (20, 2)
        assert (found.scores_3d.diff() <= 0).all()
        # the best pair of query and class, its points scaled to +-15 and +-30 m
        scores = stacked(raw).scores[-1, number].sigmoid()
        query, label = divmod(int(scores.argmax()), 3)
        assert found.labels_3d[0] == label
        expected = stacked(raw).pts[-1, number, query] * torch.tensor([30.0, 60.0])
        torch.testing.assert_close(found.pts[0], expected - torch.tensor([15.0, 30.0]))


def test_a_sample_does_not_depend_on_its_batch():
    torch.manual_seed(0)
    model = build_small().eval()
    images = make_images(2)
    samples = make_samples(NONE, NONE)
    samples[1].set_metainfo({"lidar2img": samples[1].lidar2img[::-1].copy()})
    with torch.no_grad():
        both = stacked(model._forward(images, samples)).pts
        second = stacked(model._forward({"imgs": images["imgs"][1:]}, samples[1:])).pts
    torch.testing.assert_close(both[:, 1:], second, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("gt", [NONE, ONE], ids=["no element", "one element"])
def test_a_nan_in_an_image_names_the_sample(gt):
    model = build_small().eval()
    for (
        layer
    ) in model.map_head.decoder.layers:  # as in a trained model, the query moves the samples
        torch.nn.init.normal_(layer.cross_attn.sampling_offsets.weight)
    images = make_images(1)
    images["imgs"][0, 2, 1, 5, 5] = float("nan")
    with pytest.raises(FloatingPointError, match="token-0"):
        model.loss(images, make_samples(gt))


def test_a_loss_that_is_not_finite_is_named_with_its_samples(monkeypatch):
    model = build_small()
    bad = {"loss_cls": torch.tensor(1.0), "loss_extra": torch.tensor(float("inf"))}
    monkeypatch.setattr(model.map_head, "loss", lambda *_: bad)
    with pytest.raises(FloatingPointError, match=r"\['loss_extra'\].*\['token-0', 'token-1'\]"):
        model.loss(make_images(2), make_samples(ONE, ONE))


def test_mixed_precision_trains_and_keeps_points_in_float32():
    torch.manual_seed(0)
    model = build_small().train()
    images, samples = make_images(2), make_samples(ONE, MANY)
    with torch.autocast("cpu", torch.bfloat16):
        outputs = model._forward(images, samples)
        losses = model.loss(images, samples)
    assert stacked(outputs).pts.dtype == torch.float32
    assert all(value.dtype == torch.float32 for value in losses.values())
    torch.stack(list(losses.values())).sum().backward()
    grads = [p.grad for p in model.parameters() if p.grad is not None]
    assert all(torch.isfinite(grad).all() for grad in grads)


def test_mixed_precision_stays_close_to_float32():
    torch.manual_seed(0)
    model = build_small().eval()
    images, samples = make_images(1), make_samples(NONE)
    with torch.no_grad():
        exact = stacked(model._forward(images, samples)).pts
        with torch.autocast("cpu", torch.bfloat16):
            mixed = stacked(model._forward(images, samples)).pts
    # bfloat16 keeps 8 bits; the points pass two layers of width 16
    torch.testing.assert_close(mixed, exact, atol=0.02, rtol=0)


def test_image_augmentation_is_for_training_only():
    torch.manual_seed(0)
    model = build_small(img_augment={"type": "GridMask", "prob": 1.0})
    images = torch.ones(1, 6, 3, 64, 96)
    seen = []
    model.img_backbone.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    for training in (True, False):
        model.train(training).extract_feat({"imgs": images}, make_samples(ONE))
    assert 0 < (seen[0] == 0).float().mean() < 1
    assert (seen[1] == 1).all()


def test_training_fits_one_sample():
    torch.manual_seed(0)
    model = build_small().train()
    for module in model.modules():
        if isinstance(module, torch.nn.Dropout):
            module.p = 0.0
    optimizer = torch.optim.AdamW(model.parameters(), lr=1e-2)
    images, samples = make_images(1), make_samples(ONE)
    history = []
    for _ in range(25):
        optimizer.zero_grad()
        losses = model.loss(images, samples)
        torch.stack(list(losses.values())).sum().backward()
        optimizer.step()
        history.append(losses["loss_pts"].item())
    assert history[-1] < 0.25 * history[0]
