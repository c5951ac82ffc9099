"""Fusion of detections with elements of earlier drives: which lines and scores come out."""

import numpy as np
import pytest
import torch
from head_cases import GSMAP, HEAD, build_head
from mmengine.structures import InstanceData
from model_cases import build_small, make_images, make_samples, straight_elements
from prior_cases import pose_at

from gsmap.apis.export import ExportedDetector
from gsmap.models.priors import element_fusion
from gsmap.models.priors.element_fusion import ElementFusion
from gsmap.prior import ElementPrior, ElementRule, MapPrior, PriorSettings
from gsmap.structures.elements import MapElements


@pytest.fixture(scope="module")
def plain_head():
    return build_head({**HEAD, "num_points": 20})


@pytest.fixture(scope="module")
def gaussian_head():
    return build_head({**HEAD, **GSMAP, "num_points": 20})


def straight(x, low=-20.0, high=20.0, num_points=20):
    return torch.stack([torch.full((num_points,), x), torch.linspace(low, high, num_points)], -1)


def detections(*rows):
    """Detections (x, label, score) of straight lines."""
    return InstanceData(
        pts=torch.stack([straight(x) for x, _, _ in rows]),
        labels_3d=torch.tensor([label for _, label, _ in rows]),
        scores_3d=torch.tensor([score for _, _, score in rows]),
    )


def prior_of(head, *rows, place="town", rule=None):
    """Prior of elements (x, label, confidence) in the frame of `pose_at(100)`."""
    lines = [straight(x).double().numpy() for x, _, _ in rows]
    labels, scores = [row[1] for row in rows], [row[2] for row in rows]
    elements = MapElements.from_polylines(lines, labels, scores).to_frame(pose_at(100.0))
    return ElementPrior(PriorSettings(tuple(head.classes), place), elements, rule)


def fused(head, prior, results, **settings):
    fusion = ElementFusion(head, **settings)
    meta = {"token": "a", "map_name": "town", "lidar2global": pose_at(100.0)}
    with fusion.using(fusion.maps_of([prior])):
        return fusion.update_detections([results], [meta])[0]


def rows_of(results):
    """Mean x, label and score of each detection."""
    xs = results.pts[..., 0].mean(1).tolist()
    labels, scores = results.labels_3d.tolist(), results.scores_3d.tolist()
    rows = zip(xs, labels, scores, strict=True)
    return [(round(x, 3), label, round(score, 4)) for x, label, score in rows]


def test_an_element_replaces_its_detections(plain_head):
    """Scores by hand, with m = 0.5: c (m + (1 - m) s) is 0.76 for c = 0.8 and s = 0.9."""
    prior = prior_of(plain_head, (3.0, 0, 0.8), (-6.0, 2, 0.6))
    found = detections((3.6, 0, 0.9), (2.5, 0, 0.3), (3.0, 2, 0.7), (9.0, 0, 0.2))
    result = fused(plain_head, prior, found)
    assert rows_of(result) == [
        (3.0, 0, round(1 - (1 - 0.8 * 0.95) * 0.1, 4)),  # both detections near it are gone
        (3.0, 2, 0.7),  # of another class
        (-6.0, 2, 0.3),  # not found: half of its confidence
        (9.0, 0, 0.2),  # far from all elements
    ]
    assert rows_of(fused(plain_head, prior, found, missed_share=1.0))[2] == (-6.0, 2, 0.6)
    close = rows_of(fused(plain_head, prior, found, gate_m=0.55))
    assert (3.6, 0, 0.9) in close
    assert (3.0, 0, round(1 - (1 - 0.8 * 0.65) * 0.7, 4)) in close  # found by 2.5 alone


def test_a_detection_belongs_to_the_nearest_element(plain_head):
    prior = prior_of(plain_head, (0.0, 0, 0.5), (1.0, 0, 0.5))
    result = fused(plain_head, prior, detections((0.9, 0, 1.0)))
    assert rows_of(result) == [(1.0, 0, 1.0), (0.0, 0, 0.25)]


def test_gaussians_of_elements_have_the_width_of_the_prior(gaussian_head):
    prior = prior_of(gaussian_head, (3.0, 0, 0.8), rule=ElementRule(sigma_m=0.4))
    found = detections((-9.0, 0, 0.9))
    found.scales = torch.full((1, 20, 2), 0.7)
    found.rotations = torch.full((1, 20), 0.1)
    result = fused(gaussian_head, prior, found)
    assert result.scales[0].eq(0.7).all()
    assert result.rotations[0].eq(0.1).all()
    torch.testing.assert_close(result.scales[1, :, 1], torch.full((20,), 0.4))
    torch.testing.assert_close(result.scales[1, 1:-1, 0], torch.full((18,), 20 / 19))
    torch.testing.assert_close(result.rotations[1], torch.full((20,), torch.pi / 2))


def test_without_elements_or_a_prior_nothing_changes(plain_head, monkeypatch):
    messages = []
    monkeypatch.setattr(element_fusion, "print_log", lambda text, **_: messages.append(text))
    found = detections((1.0, 0, 0.9))
    fusion = ElementFusion(plain_head)
    assert fusion.update_detections([found], [{"token": "a"}]) == [found]
    assert fusion.update_detections([found], [{"token": "b"}]) == [found]
    assert len(messages) == 1
    assert "ElementFusion has no prior" in messages[0]
    prior = prior_of(plain_head)
    assert fused(plain_head, prior, found) is found
    assert len(messages) == 1
    nothing = fused(plain_head, prior_of(plain_head, (1.0, 0, 0.5)), found[torch.tensor([False])])
    assert rows_of(nothing) == [(1.0, 0, 0.25)]


def test_other_priors_places_and_settings_are_refused(plain_head):
    fusion = ElementFusion(plain_head)
    settings = PriorSettings(tuple(plain_head.classes), "town")
    with pytest.raises(ValueError, match=r"the prior of 'town' has no elements.*--elements"):
        fusion.maps_of([MapPrior(settings)])
    prior = prior_of(plain_head, (1.0, 0, 0.5))
    with pytest.raises(ValueError, match="has elements, which a model can only read"):
        fusion.maps_of([prior], update=True)
    with pytest.raises(ValueError, match="ElementFusion writes to no prior"):
        fusion.new_prior("town")
    with (
        pytest.raises(ValueError, match="a sample has none"),
        fusion.using(fusion.maps_of([prior])),
    ):
        fusion.update_detections([detections((1.0, 0, 0.9))], [{"token": "a"}])
    elsewhere = {"token": "a", "map_name": "oslo", "lidar2global": pose_at(0.0)}
    with pytest.raises(ValueError, match="is in 'oslo'"), fusion.using(fusion.maps_of([prior])):
        fusion.update_detections([detections((1.0, 0, 0.9))], [elsewhere])
    for setting in ({"gate_m": 0.0}, {"missed_share": 1.5}, {"missed_share": np.nan}):
        with pytest.raises(ValueError, match="ElementFusion needs gate_m > 0"):
            ElementFusion(plain_head, **setting)
    high = detections((1.0, 0, 0.9))
    high.pts = torch.cat([high.pts, torch.zeros(1, 20, 1)], -1)
    with pytest.raises(ValueError, match="needs detections without heights"):
        fused(plain_head, prior, high)
    further = detections((1.0, 0, 0.9))
    further.width = torch.ones(1)
    with pytest.raises(ValueError, match="cannot make 'width' of detections"):
        fused(plain_head, prior, further)


def test_a_model_reads_elements_and_learns_as_before():
    lines = straight_elements(((-3, -20), (-3, 20)), labels=[0])
    samples = make_samples(lines, lines)
    for number, sample in enumerate(samples):
        pose = pose_at(100.0 * number)
        sample.set_metainfo({"map_name": "town", "lidar2global": pose})
    model = build_small(prior={"type": "ElementFusion"}).eval()
    inputs = make_images(2)
    plain = build_small().eval()
    with torch.no_grad():
        expected = [sample.pred_instances_3d for sample in plain.predict(inputs, samples)]
        alone = [sample.pred_instances_3d for sample in model.predict(inputs, samples)]
        prior = prior_of(model.map_head, (3.0, 2, 0.875))
        with model.prior.using(model.prior.maps_of([prior])):
            given = [sample.pred_instances_3d for sample in model.predict(inputs, samples)]
    for one, other in zip(alone, expected, strict=True):
        torch.testing.assert_close(one.pts, other.pts, rtol=0, atol=0)
    torch.testing.assert_close(given[0].pts, expected[0].pts, rtol=0, atol=0)  # 100 m before
    assert (prior.reads.samples, prior.reads.empty) == (2, 1)
    is_element = given[1].labels_3d == 2
    is_element &= (given[1].pts[..., 0] - 3.0).abs().amax(1) < 1e-4
    assert is_element.sum() == 1
    assert model.state_dict().keys() == plain.state_dict().keys()
    model.train()
    plain.train()
    torch.manual_seed(0)
    losses = model.loss(inputs, samples)
    torch.manual_seed(0)
    assert losses.keys() == plain.loss(inputs, samples).keys()
    with pytest.raises(ValueError, match="ElementFusion works behind the network"):
        ExportedDetector(model.eval())
