"""Detections that are seen again: which line they take, and how sure they become."""

import math

import numpy as np
import pytest
import shapely
import torch
from head_cases import GSMAP, HEAD, build_head
from mmengine.structures import InstanceData
from model_cases import build_small, make_images, make_samples, small_config, straight_elements

from gsmap.apis.export import ExportedDetector
from gsmap.models.streams.element_memory import ElementMemory
from gsmap.models.streams.memory import StreamMemory
from gsmap.structures.gaussians import Gaussians, covariances, gaussians_along
from gsmap.structures.line_update import nearest_places, update_from_known_lines
from gsmap.structures.past import Past
from gsmap.structures.rigid import rigid


def line(x: float, low: float = -8.0, high: float = 8.0, across: float = 0.3) -> Gaussians:
    """Return an element of 9 points along y, with Gaussians that are long in its direction."""
    y = torch.linspace(low, high, 9, dtype=torch.float64)
    points = torch.stack([torch.full_like(y, x), y], -1)
    scales = torch.tensor([1.0, across], dtype=torch.float64).expand(9, 2)
    return Gaussians(points[None], scales[None], torch.full((1, 9), math.pi / 2).double())


def detected(gaussians: Gaussians, label: int = 0, score: float = 0.5) -> InstanceData:
    """Return a detection of these Gaussians."""
    means, scales, rotations = (part.float() for part in gaussians)
    return InstanceData(
        pts=means,
        scales=scales,
        rotations=rotations,
        labels_3d=torch.tensor([label]),
        scores_3d=torch.tensor([score]),
    )


def memory(**settings) -> ElementMemory:
    return ElementMemory(build_head({**HEAD, **GSMAP}), **settings)


def past(left: dict, motion=None, seconds: float = 0.5, continues: bool = True) -> Past:
    motion = torch.eye(4).double() if motion is None else motion
    return Past(left, motion[None], torch.tensor([seconds]).double(), torch.tensor([continues]))


ZERO = torch.zeros(1, dtype=torch.long)


def test_nearest_places_are_shapelys():
    generator = np.random.default_rng(0)
    points, lines = generator.normal(size=(3, 6, 2)) * 5, generator.normal(size=(3, 5, 2)) * 5
    found = nearest_places(torch.tensor(points), torch.tensor(lines))
    wanted = [
        [shapely.Point(p).distance(shapely.LineString(other)) for p in own]
        for own, other in zip(points, lines, strict=True)
    ]
    np.testing.assert_allclose(found.distances.numpy(), wanted, atol=1e-12)


def test_a_point_is_updated_across_the_line_as_by_a_kalman_filter_and_not_along_it():
    new, known = line(1.0, low=-7.0, high=9.0, across=0.4), line(0.0, across=0.3)
    found = update_from_known_lines(new, ZERO, known, ZERO, gate_m=3.0)
    gain = 0.4**2 / (0.4**2 + 0.3**2)
    beside = new.means[0, :, 1] <= 8.0
    x, y = found.means[0].unbind(-1)
    torch.testing.assert_close(x[beside], torch.full_like(x[beside], 1 - gain))
    torch.testing.assert_close(y, new.means[0, :, 1])  # points are spread anew in each frame
    variances = covariances(found)[0, beside]
    expected = torch.tensor([[(1 - gain) * 0.4**2, 0.0], [0.0, 1.0]]).double()
    torch.testing.assert_close(variances, expected.expand_as(variances))
    torch.testing.assert_close(x[~beside], torch.ones_like(x[~beside]))  # beyond its end
    assert int((~beside).sum()) == 1


@pytest.mark.parametrize(
    ("known", "labels", "gate_m"),
    [(line(0.0), ZERO + 1, 3.0), (line(0.0), ZERO, 0.9), (line(0.0, 9.5, 12.0), ZERO, 3.0)],
)
def test_another_class_a_far_line_and_one_that_lies_ahead_change_nothing(known, labels, gate_m):
    new = line(1.0)
    found = update_from_known_lines(new, ZERO, known, labels, gate_m)
    for ours, own in zip(found, new, strict=True):
        assert torch.equal(ours, own)


def test_of_two_lines_the_nearer_one_is_seen_again():
    known = Gaussians(*(torch.cat(both) for both in zip(line(3.0), line(0.4), strict=True)))
    found = update_from_known_lines(line(1.0), ZERO, known, torch.zeros(2, dtype=torch.long), 3.0)
    torch.testing.assert_close(found.means[0, :, 0], torch.full((9,), 0.7).double())


def test_among_many_lines_an_element_is_updated_as_by_the_nearest_one_alone():
    """Lines whose boxes are too far apart are not measured, which must change nothing."""
    torch.manual_seed(0)
    gate_m = 4.0
    starts, steps = torch.rand(2, 24, 1, 2).double() * 24 - 12, torch.rand(2, 24, 1, 2) - 0.5
    places = starts + steps * torch.arange(9.0)[:, None]
    now, known = (gaussians_along(points, 0.3) for points in places)
    labels = torch.arange(24) % 2
    found = update_from_known_lines(now, labels, known, labels, gate_m)
    for index, points in enumerate(places[0]):
        same = (labels == labels[index]).nonzero()[:, 0]
        near = nearest_places(points.expand(len(same), -1, -1), known.means[same])
        mean = (near.distances * near.beside).sum(-1) / near.beside.sum(-1).clamp(min=1)
        mean[near.beside.sum(-1) < 2] = torch.inf
        one = same[mean.argmin()][None]
        own = Gaussians(*(part[index, None] for part in now))
        alone = update_from_known_lines(
            own, labels[one], Gaussians(*(part[one] for part in known)), labels[one], gate_m
        )
        torch.testing.assert_close(found.means[index], alone.means[0])
    updated = (found.means - now.means).abs().amax((1, 2)) > 0
    assert 4 < int(updated.sum()) < 24


def test_what_a_frame_leaves_moves_with_the_vehicle_and_grows_by_the_noise():
    elements = memory(noise_m=0.2, noise_deg=0.0)
    left = elements.remember([detected(line(2.0))])
    assert left["element_labels"].tolist() == [[0] + [-1] * (elements.num - 1)]
    motion = torch.eye(4).double()
    motion[0, 3] = -2.0  # the vehicle has moved 2 m along x
    (found,) = elements.update_detections([detected(line(1.0))], past(left, motion))
    known, new = 0.3**2 + 0.2**2 * 0.5, 0.3**2
    torch.testing.assert_close(found.pts[0, 4, 0], torch.tensor(known / (known + new)).float())
    assert torch.all(found.scales[0, :, 1] < 0.3)


def test_a_stream_that_starts_and_an_unlikely_element_stay_as_they_are():
    elements = memory(min_score=0.2)
    left = elements.remember([detected(line(0.0))])
    for now, before in [
        (detected(line(1.0)), past(left, continues=False)),
        (detected(line(1.0)), past({})),
        (detected(line(1.0), score=0.1), past(left)),
        (detected(line(1.0)), past(elements.remember([detected(line(0.0), score=0.1)]))),
    ]:
        (found,) = elements.update_detections([now], before)
        assert torch.equal(found.pts, now.pts)


def remembering(**temporal):
    """Return a tiny GSMap with memory."""
    head = {**small_config()["map_head"], "type": "GSMapHead"}
    return build_small(map_head=head, temporal=temporal).eval()


def test_a_batch_of_streams_is_updated_as_each_stream_alone():
    elements = memory()
    before = [detected(line(0.0)), detected(line(5.0))]
    now = [detected(line(0.6)), detected(line(4.0), score=0.9)]
    motion = torch.eye(4).double().repeat(2, 1, 1)
    motion[1, 0, 3] = 0.3
    seconds, continues = torch.tensor([0.5, 1.0]).double(), torch.tensor([True, True])
    batch = elements.update_detections(
        now, Past(elements.remember(before), motion, seconds, continues)
    )
    for index, found in enumerate(batch):
        own = elements.remember(before[index : index + 1])
        past_of_one = past(own, motion[index], float(seconds[index]))
        (alone,) = elements.update_detections(now[index : index + 1], past_of_one)
        assert not torch.equal(found.pts, now[index].pts)
        assert torch.equal(found.pts, alone.pts)
        assert torch.equal(found.scales, alone.scales)


def predicted(number: int, model) -> InstanceData:
    """Predict one frame of a scene, whose images are those of its number."""
    torch.manual_seed(number)
    (sample,) = make_samples(straight_elements())
    pose = rigid(np.eye(3), [0, 2.0 * number, 0])
    frame = {"scene": "a", "timestamp_ns": number * 500_000_000, "lidar2global": pose}
    sample.set_metainfo({**frame, "token": f"a{number}"})
    with torch.no_grad():
        (found,) = model.predict(make_images(1), [sample])
    return found.pred_instances_3d


def test_a_detector_updates_its_elements_from_the_second_frame_on():
    model = remembering(elements={"min_score": 0.0}, half=True)
    updated = [predicted(number, model) for number in range(2)]
    assert model.temporal.streams.states["a"].values["element_means"].dtype == torch.float32
    model.temporal.elements = None
    model.eval()  # forgets
    first, second = (predicted(number, model) for number in range(2))
    assert torch.equal(first.pts, updated[0].pts)
    assert torch.equal(second.scores_3d, updated[1].scores_3d)
    assert not torch.allclose(second.pts, updated[1].pts)
    assert float(updated[1].scales.mean()) < float(second.scales.mean())


def test_elements_alone_need_no_poses_in_training():
    model = remembering(elements={}).train()
    torch.manual_seed(0)
    losses = model.loss(make_images(1), make_samples(straight_elements()))
    assert torch.isfinite(sum(losses.values()))
    assert model.temporal.streams.states == []


def test_no_onnx_file_leaves_out_the_memory_of_elements_in_silence():
    with pytest.raises(ValueError, match=r"set model.temporal.elements=None"):
        ExportedDetector(remembering(elements={}))


def test_the_defaults_are_those_of_the_measured_figures():
    elements = memory()
    assert (elements.gate_m, elements.min_score, elements.noise_m) == (3.0, 0.05, 0.05)
    assert elements.noise_rad == math.radians(0.15)


def test_settings_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match=r"temporal.elements needs a head with Gaussians"):
        StreamMemory(build_head(HEAD), elements={})
    with pytest.raises(ValueError, match="gate_m > 0"):
        memory(gate_m=0.0)
    with pytest.raises(ValueError, match="temporal needs at least one of bev"):
        StreamMemory(build_head(HEAD))
