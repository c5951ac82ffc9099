"""A detector with a raster prior: reading, writing, training, resuming and its errors."""

import copy
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from methods.hrmapnet.prior_cases import PRIOR, prior_model
from model_cases import build_small, make_images, small_config
from prior_cases import CLASSES, frames, pose_at

from gsmap.apis.rig_fit import fit_start
from gsmap.models.hrmapnet import raster_prior
from gsmap.models.hrmapnet.raster_prior import CELLS, KEYS, VALID
from gsmap.prior import KeepMaximum, LastSeen, MapPrior, PriorSettings
from gsmap.prior.places import Place

TOWN = PriorSettings(CLASSES, "town", cell_m=1.25)


def train_step(model, samples, seed=0):
    """Return the sum of the losses of a step of plain gradient descent."""
    torch.manual_seed(seed)
    losses = model(make_images(len(samples)), samples, mode="loss")
    total, _ = model.parse_losses(losses)
    model.zero_grad()
    total.backward()
    with torch.no_grad():
        for parameter in model.parameters():
            if parameter.grad is not None:
                parameter -= 1e-4 * parameter.grad
    return total.detach()


@torch.no_grad()
def predict(model, samples, seed=0):
    torch.manual_seed(seed)
    return model(make_images(len(samples)), samples, mode="predict")


def window_of(model, town="town", scene="a", x=0.0):
    model.prior.flush()
    return model.prior.maps.read(Place("", name=town, scene=scene, pose=pose_at(x)))


def test_each_part_learns_from_the_map_of_the_step_before():
    model = prior_model().train()
    samples = frames(("town", "a", 0.0), ("town", "b", 3.0))
    for step in range(2):
        train_step(model, samples, seed=step)
        prior = model.prior
        learned = prior.queries.label_encoder.weight.grad.abs().sum() > 0
        assert learned == (step == 1)  # the map is empty at first
        assert (prior.bev.layer.bev_embedding.weight.grad.abs().sum() > 0) == (step == 1)
        assert prior.bev.conv[0].weight.grad.abs().sum() > 0
    assert all(parameter.grad is not None for parameter in model.prior.parameters())


@pytest.mark.parametrize("neutral", [False, True])
@pytest.mark.parametrize(
    "names",
    [
        ["boundary", "divider", "ped_crossing"],
        ["stop_line", "divider", "ped_crossing", "boundary"],
        ["divider", "kerb"],
    ],
    ids=["other order", "one more", "fewer"],
)
def test_a_trained_prior_reads_its_classes_by_name(names, neutral):
    """A crossing and a divider of the map have the effect that they have in the trained model."""
    settings = {**PRIOR, "neutral_start": neutral}
    trained = build_small(0, classes=list(CLASSES), prior=settings).prior.eval()
    model = build_small(1, classes=names, prior=settings)
    state = {f"prior.{key}": value for key, value in trained.state_dict().items()}
    metainfo = {"classes": names, "x_range": (-15.0, 15.0), "y_range": (-30.0, 30.0)}
    data = SimpleNamespace(metainfo={**metainfo, "frame": "lidar"}, cameras=None)
    fit_start(state, model, data, {"classes": list(CLASSES)})
    prior = model.prior.eval()
    prior.load_state_dict({key.removeprefix("prior."): value for key, value in state.items()})
    window, expected_window = (
        torch.zeros(1, len(classes), part.window.height, part.window.width)
        for part, classes in ((prior, names), (trained, CLASSES))
    )
    for name, rows in (("divider", slice(0, 9)), ("ped_crossing", slice(6, 20))):
        if name in names:
            window[:, names.index(name), rows, 3:5] = 1.0
            expected_window[:, CLASSES.index(name), rows, 3:5] = 1.0
    feats = torch.randn(1, 16, prior.cells.height, prior.cells.width)
    results = []
    for part, values in ((prior, window), (trained, expected_window)):
        cells = F.pixel_unshuffle(values, part.scale)
        fused = part.bev.conv(torch.cat([feats, cells], dim=1))
        results.append((fused, part.queries.label_encoder(cells.movedim(1, -1))))
    for found, expected in zip(*results, strict=True):
        torch.testing.assert_close(found, expected)


def test_training_keeps_the_largest_value_and_testing_the_last():
    model = prior_model().train()
    assert model.prior.maps.rule == KeepMaximum()
    train_step(model, frames(("town", "a", 0.0)))
    assert window_of(model).amax() > 0
    model.eval()
    assert model.prior.maps.rule == LastSeen(gain=30.0, lowest=2, highest=240)
    assert not window_of(model).any()  # a test starts from an empty map
    predict(model, frames(("town", "a", 0.0)))
    assert window_of(model).amax() > 0
    assert not window_of(model, town="city").any()
    model.train()
    assert not window_of(model).any()  # an epoch, too


def test_a_written_window_holds_the_drawn_predictions():
    model = prior_model().eval()
    (sample,) = predict(model, frames(("town", "a", 0.0)))
    found = sample.pred_instances_3d
    scores = torch.full((len(found), 3), -20.0)
    scores[range(len(found)), found.labels_3d] = found.scores_3d.logit()
    drawn = model.prior.draw(scores, found.pts)
    # the rule stores steps of 1 / 30, rounded down
    torch.testing.assert_close(window_of(model), drawn, atol=1 / 30 + 1e-5, rtol=0)
    assert drawn.amax() > 0.9


def test_only_sure_predictions_are_drawn():
    model = prior_model(score_threshold=0.4).eval()
    points = torch.linspace(-10, 10, 20)[None, :, None].expand(2, -1, 2)
    logits = torch.full((2, 3), -9.0)
    logits[0, 2] = torch.tensor(0.41).logit()
    logits[1, 0] = torch.tensor(0.39).logit()
    raster = model.prior.draw(logits, points)
    assert raster[2].amax() > 0.9
    assert not raster[:2].any()


def test_scores_are_those_of_the_coder():
    """With sigma_power, an element is drawn if its weighted score is above the threshold."""
    head = {**small_config()["map_head"], "type": "GSMapHead", "coder": {"sigma_power": 2.0}}
    model = build_small(map_head=head, prior={**PRIOR, "score_threshold": 0.4}).eval()
    (sample,) = predict(model, frames(("town", "a", 0.0)))
    found = sample.pred_instances_3d
    (pending,) = model.prior._pending
    best = model.map_head.coder.decode(pending.scores.read()[0], pending.points_m.read()[0])
    torch.testing.assert_close(best.scores, found.scores_3d)
    assert window_of(model).any() == (found.scores_3d > 0.4).any()


def test_windows_of_fixed_sizes_give_equal_features_and_queries():
    """A prediction selects cells on the host; an exported model masks all cells."""
    model = prior_model().eval()
    predict(model, frames(("town", "a", 0.0)))
    samples = frames(("town", "a", 2.0), ("city", "a", 2.0))
    torch.manual_seed(0)
    inputs = make_images(2)
    with torch.no_grad():
        selected = model.extract_feat(inputs, samples)
        prior, model.prior = model.prior, None
        outputs = model.extract_feat(inputs, samples)
        model.prior = prior
        metas = [sample.metainfo for sample in samples]
        windows = torch.stack([prior.maps.read(Place.of(meta)) for meta in metas])
        from gsmap.models.encoders.camera_encoder import stack_calibration

        calibration = stack_calibration(metas, prior.calibration, windows.device)
        masked = prior.fuse_window(outputs, windows, calibration, img_shape=(64, 96))
        assert selected[VALID].sum(1).tolist() == masked[VALID].sum(1).tolist()
        assert selected[VALID][0].any()
        assert not selected[VALID][1].any()
        assert selected[KEYS].shape[1] < masked[KEYS].shape[1]
        torch.testing.assert_close(selected[CELLS], masked[CELLS])
        torch.testing.assert_close(selected["bev_feats"], masked["bev_feats"])
        found = [
            model.map_head(out, hooks=(prior.hook(out),))[-1].pts for out in (selected, masked)
        ]
    torch.testing.assert_close(*found, atol=1e-5, rtol=1e-5)


def test_the_parts_are_switches():
    for settings in ({"bev": None}, {"queries": None}, {"bev": {"layer": None}}):
        model = prior_model(**settings).train()
        for step in range(2):
            train_step(model, frames(("town", "a", 0.0)), seed=step)
        missing = [name for name, p in model.prior.named_parameters() if p.grad is None]
        assert not missing
        predict(model.eval(), frames(("town", "a", 0.0)))


def test_frames_without_poses_train_and_predict_without_a_map():
    model = prior_model().train()
    losses = train_step(model, frames(None, None))
    assert losses.isfinite()
    predicted = predict(model.eval(), frames(None))[0].pred_instances_3d
    assert predicted.scores_3d.isfinite().all()


def test_without_a_memory_the_order_of_frames_does_not_matter():
    model = prior_model(test_memory="none").eval()
    first, again = (
        predict(model, frames(("town", "a", 0.0)))[0].pred_instances_3d for _ in range(2)
    )
    torch.testing.assert_close(first.pts, again.pts, rtol=0, atol=0)


def test_epochs_after_a_resume_are_equal_bit_for_bit():
    """The map is empty at the start of each epoch, so a checkpoint at its end needs none."""
    batches = [frames(("town", "a", float(x)), ("town", "b", 5.0 + x)) for x in range(3)]

    def epoch(model, seed):
        model.train()
        return [train_step(model, batch, seed=seed + n) for n, batch in enumerate(batches)]

    model = prior_model()
    epoch(model, seed=0)
    state = copy.deepcopy(model.state_dict())
    expected = epoch(model, seed=10)
    resumed = prior_model(seed=1)
    resumed.load_state_dict(state)
    found = epoch(resumed, seed=10)
    assert torch.equal(torch.stack(found), torch.stack(expected))
    for name, value in model.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[name]), name


def test_a_given_prior_is_read_and_stays_over_tests():
    model = prior_model().eval()
    predict(model, frames(("town", "a", 0.0)))
    window = window_of(model)
    prior = MapPrior(TOWN, KeepMaximum())
    prior.write(pose_at(0), model.prior.window, window)
    before = prior.read(pose_at(0), model.prior.window)
    model.prior.use(model.prior.maps_of([prior]))
    model.eval()
    torch.testing.assert_close(window_of(model), before)
    predict(model, frames(("town", "a", 1.0)))
    torch.testing.assert_close(prior.read(pose_at(0), model.prior.window), before)  # only read
    with model.prior.using(model.prior.maps_of([prior], update=True)):
        predict(model, frames(("town", "a", 8.0)), seed=3)
    assert not torch.equal(prior.read(pose_at(0), model.prior.window), before)


def test_several_processes_that_keep_maps_are_warned(monkeypatch):
    model = prior_model()
    lines = []
    monkeypatch.setattr(raster_prior, "print_log", lambda line, **_: lines.append(line))
    model.eval()
    assert not lines
    monkeypatch.setattr(raster_prior, "get_world_size", lambda: 2)
    model.train()
    assert not lines
    model.eval()
    assert "each process keeps its own map" in lines[0]


def test_a_model_with_a_map_can_be_copied():
    model = prior_model().eval()
    predict(model, frames(("town", "a", 0.0)))
    copied = copy.deepcopy(model)
    assert window_of(model).any()
    assert not window_of(copied).any()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"bev": None, "queries": None}, "prior needs bev, queries or both"),
        ({"cell_m": 1.5}, r"prior\.cell_m is 1\.5: the side of BEV cells, 5 m, must be a multiple"),
        ({"cell_m": 15.0}, r"prior\.cell_m is 15"),
        ({"test_memory": "never"}, "memory of a prior must be one of"),
        ({"test_rule": {"name": "newest"}}, "rule of a prior must be one of"),
        ({"train_rule": {"gain": 3.0}}, "rule keep_maximum of a prior takes other settings"),
    ],
)
def test_settings_that_do_not_fit_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        prior_model(**settings).eval()


def test_a_model_without_its_parts_is_refused():
    class Pivot:
        pass

    from gsmap.models.hrmapnet.raster_prior import RasterPrior

    model = build_small()
    with pytest.raises(ValueError, match="Pivot can have no prior, which needs a MapHead"):
        RasterPrior(Pivot(), model.bev_encoder)
    with pytest.raises(ValueError, match="NoneType can have no prior, which needs a BEV encoder"):
        RasterPrior(model.map_head, None)
    model.map_head.bev_dims *= 2
    with pytest.raises(ValueError, match=r"MapHead can have no RasterPrior, .* have 16, .* 32"):
        RasterPrior(model.map_head, model.bev_encoder)


def test_an_encoder_with_another_order_of_rows_can_have_a_prior():
    encoder = {**small_config()["bev_encoder"], "type": "StreamMapNetEncoder", "num_levels": 1}
    model = build_small(bev_encoder=encoder, prior=PRIOR).eval()
    (found,) = predict(model, frames(("town", "a", 0.0)))
    assert len(found.pred_instances_3d) > 0


def test_a_pose_that_is_none_is_refused():
    model = prior_model().eval()
    samples = frames(("town", "a", 0.0))
    samples[0].set_metainfo({"lidar2global": np.zeros((4, 4))})
    with pytest.raises(ValueError, match="must be a rigid motion"):
        predict(model, samples)


def test_published_settings_are_the_defaults():
    model = prior_model()
    settings = {key: PRIOR[key] for key in ("type",)}
    prior = build_small(prior={**settings, "cell_m": 5.0}).prior
    assert (prior.score_threshold, prior.softness, prior.test_memory) == (0.4, 2.0, "kept")
    assert (prior.queries.stride, prior.queries.threshold, prior.bev.threshold) == (2, 0.8, 0.8)
    assert prior.queries.attention.num_heads == 8
    assert prior.num_channels == 3
    assert model.prior.num_channels == 3 * 16


def test_a_neutral_prior_starts_from_the_checkpoint_of_a_model_without_one():
    plain = build_small(0).eval()
    model = prior_model(1, neutral_start=True).eval()
    with pytest.raises(ValueError, match="missing: prior"):
        prior_model(1).load_state_dict(plain.state_dict())
    model.load_state_dict(plain.state_dict())
    samples = frames(("town", "a", 0.0))
    (expected,) = predict(plain, samples)
    for _ in range(2):  # with an empty map, and with a written one
        (found,) = predict(model, samples)
        torch.testing.assert_close(found.pred_instances_3d.pts, expected.pred_instances_3d.pts)
        torch.testing.assert_close(
            found.pred_instances_3d.scores_3d, expected.pred_instances_3d.scores_3d
        )
    assert window_of(model).any()


def test_a_prior_with_a_part_that_is_not_neutral_is_not_left_untrained_in_silence():
    state = build_small(0).state_dict()
    for part in ({"bev": {"layer": None, "residual": False}}, {"queries": {"zero_init": False}}):
        model = prior_model(1, neutral_start=True, **part)
        with pytest.raises(ValueError, match="missing: prior"):
            model.load_state_dict(state)


def test_published_training_draws_no_random_numbers_for_dropped_maps():
    model = prior_model().train()
    samples = frames(("town", "a", 0.0))
    metas = [sample.metainfo for sample in samples]
    outputs = {"bev_feats": torch.zeros(1, 32, 12, 6), "img_feats": None}
    model.prior.bev = None
    before = torch.get_rng_state()
    model.prior.fuse(outputs, metas, img_shape=(64, 96))
    assert torch.equal(torch.get_rng_state(), before)


def test_a_neutral_prior_learns():
    model = prior_model(neutral_start=True).train()
    samples = frames(("town", "a", 0.0), ("town", "b", 3.0))
    prior = model.prior
    for step in range(3):
        train_step(model, samples, seed=step)
        assert prior.bev.output_conv.weight.grad.any()
        # the first output is 0; cells that are read need a map and a step that has moved the output
        assert prior.queries.attention.out_proj.weight.grad.any() == (step > 0)
        assert bool(prior.bev.conv[0].weight.grad.any()) == (step > 0)
        assert bool(prior.queries.label_encoder.weight.grad.any()) == (step > 1)


def test_a_dropped_map_is_empty_in_training_only():
    torch.manual_seed(0)
    samples = frames(("town", "a", 0.0))
    metas = [sample.metainfo for sample in samples]
    outputs = {"bev_feats": torch.zeros(1, 32, 12, 6), "img_feats": None}
    read = {}
    for train_drop in (0.0, 0.999):
        model = prior_model(train_drop=train_drop, bev=None).train()
        train_step(model, samples)
        read[train_drop] = model.prior.fuse(outputs, metas, img_shape=(64, 96))[CELLS].any()
        model.eval()
        predict(model, samples)
        assert model.prior.fuse(outputs, metas, img_shape=(64, 96))[CELLS].any()
    assert read[0.0]
    assert not read[0.999]
    with pytest.raises(ValueError, match=r"train_drop must be in \[0, 1\)"):
        prior_model(train_drop=1.0)
