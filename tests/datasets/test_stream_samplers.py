"""Samplers of drives: pieces in order, deterministic and resumable, ranks that share nothing."""

from itertools import chain, pairwise

import pytest

from gsmap.datasets import stream_samplers
from gsmap.datasets.stream_samplers import StreamBatches, StreamTestSampler, StreamTrainSampler
from gsmap.datasets.vectorized_map_dataset import VectorizedMapDataset

LENGTHS = [5, 6, 7, 8, 5, 6, 7, 9, 6, 5]


class Drives(VectorizedMapDataset):
    """Scenes of given lengths, their samples numbered through."""

    def __init__(self, lengths=LENGTHS) -> None:
        self.of_scene = []
        start = 0
        for length in lengths:
            self.of_scene.append(list(range(start, start + length)))
            start += length

    def scenes(self) -> list[list[int]]:
        return self.of_scene

    def __len__(self) -> int:
        return sum(map(len, self.of_scene))


@pytest.fixture
def rank(monkeypatch):
    """Let the samplers believe to be one of some ranks."""

    def choose(number: int, count: int) -> None:
        monkeypatch.setattr(stream_samplers, "get_dist_info", lambda: (number, count))

    choose(0, 1)
    return choose


def batches(count: int, **settings) -> list[list[int]]:
    """Return the first batches of two slots."""
    sampler = StreamTrainSampler(Drives(), 2, **settings)
    endless = sampler.batches()
    return [next(endless) for _ in range(count)]


def scene_of_samples() -> dict[int, int]:
    """Number of the scene of each sample."""
    scene_of = {}
    for scene, samples in enumerate(Drives().of_scene):
        for sample in samples:
            scene_of[sample] = scene
    return scene_of


def continued(found: list[list[int]]) -> float:
    """Return the share of samples that follow the one before in their slot and scene."""
    scene_of = scene_of_samples()
    following = []
    for batch, next_batch in pairwise(found):
        for sample, next_sample in zip(batch, next_batch, strict=True):
            is_same_scene = scene_of[sample] == scene_of[next_sample]
            following.append(next_sample == sample + 1 and is_same_scene)
    return sum(following) / len(following)


def test_samples_of_a_piece_follow_one_another(rank):
    found = batches(120)
    assert continued(found) > 0.6  # pieces have three samples or so
    assert len(found[0]) == len(found[1]) == 2


def test_single_frames_come_first_and_the_late_switch_is_later(rank):
    found = batches(300, single_frame_iters=60, late_switch=False)
    late = batches(300, single_frame_iters=60, late_switch=True)
    assert continued(found[:60]) < 0.1
    assert continued(found[60:90]) > 0.5
    assert continued(late[60:90]) < continued(found[60:90])
    assert continued(late[250:]) > 0.5


def test_the_same_epoch_gives_the_same_samples_and_epochs_continue(rank):
    sampler = StreamTrainSampler(Drives(), 2)
    first = list(sampler)
    assert first == list(sampler)
    assert len(first) == len(sampler) == 64
    sampler.set_epoch(1)
    endless = sampler.batches()
    both = []
    for _ in range(64):
        both += next(endless)
    assert first + list(sampler) == both


def test_ranks_draw_differently_from_the_same_order_of_scenes(rank):
    scene_of = scene_of_samples()
    starts = set()
    for number in range(2):
        rank(number, 2)
        (first_batch,) = batches(1)
        starts.update(scene_of[sample] for sample in first_batch)
    assert len(starts) == 4  # of one permutation


def test_testing_hands_out_each_sample_once_and_whole_scenes_to_a_rank(rank):
    found = []
    for number in range(3):
        rank(number, 3)
        sampler = StreamTestSampler(Drives())
        assert len(list(sampler)) == len(sampler)
        for scene in sampler.scenes:
            assert scene == sorted(scene)
        found += list(sampler)
    assert sorted(found) == list(range(64))


def test_batches_of_streams_never_have_two_samples_of_a_scene(rank):
    scene_of = scene_of_samples()
    sampler = StreamBatches(StreamTestSampler(Drives()), 4)
    found = list(sampler)
    assert len(found) == len(sampler)
    for batch in found:
        assert len({scene_of[sample] for sample in batch}) == len(batch)
    for batch in found[:10]:
        assert len(batch) == 4
    samples = list(chain.from_iterable(found))
    assert sorted(samples) == list(range(64))
    last_of_scene: dict[int, int] = {}
    for sample in samples:
        scene = scene_of[sample]
        assert last_of_scene.get(scene, -1) < sample
        last_of_scene[scene] = sample


def test_a_data_set_without_scenes_is_refused(rank):
    with pytest.raises(TypeError, match="need a VectorizedMapDataset, got list"):
        StreamTestSampler([1, 2])
    with pytest.raises(ValueError, match="slots and pieces"):
        StreamTrainSampler(Drives(), 0)
