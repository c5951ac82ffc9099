"""Memory over frames: who continues whom, what is moved, and that no two streams touch."""

import copy
import math
import pickle

import numpy as np
import pytest
import torch
from head_cases import ALONG_Y, GSMAP, HEAD, LANES, bev, build_head
from mmengine.structures import InstanceData
from model_cases import build_small, make_images, make_samples, straight_elements

from gsmap.models.streams.bev_memory import BEVMemory
from gsmap.models.streams.memory import StreamMemory, stack_past
from gsmap.structures.past import Past
from gsmap.structures.rigid import rigid
from gsmap.structures.streams import Frame, MapStream, Scenes, Slots, StreamState

HALF_S = 500_000_000


def pose(ahead_m: float, yaw_rad: float = 0.0) -> np.ndarray:
    """Return a vehicle that has driven along y and turned."""
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    return rigid([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]], [0, ahead_m, 0])


def meta(number: int, scene: str = "a", **changes) -> dict:
    """Return the metainfo of a scene's sample, 2 m after the one before."""
    return {
        "token": f"{scene}{number}",
        "scene": scene,
        "timestamp_ns": number * HALF_S,
        "lidar2global": pose(2.0 * number, 0.1 * number),
        **changes,
    }


def with_memory(**settings):
    """Return a head and its memory, with reproducible weights that do something."""
    head = build_head({**HEAD, **settings})
    memory = StreamMemory(head, bev={}, queries={"num": 2}, embed_dims=16)
    torch.manual_seed(3)
    for parameter in memory.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    return head.eval(), memory.eval()


def step(head, memory, *metas: dict, feats: torch.Tensor | None = None) -> torch.Tensor:
    """Predict one batch and return the points of the last layer."""
    outputs = {"bev_feats": bev(len(metas))["bev_feats"] if feats is None else feats}
    with torch.no_grad(), memory.remember_batch(outputs, metas) as batch:
        return head(batch.outputs, **batch.hooks)[-1].pts


def features(number: int) -> torch.Tensor:
    """Return the features of one sample."""
    return torch.randn(1, 16, 10, 5, generator=torch.Generator().manual_seed(number))


@pytest.mark.parametrize("kind", ["MapHead", "GSMapHead"])
def test_results_are_equal_one_by_one_and_in_batches_of_streams(kind):
    config = {"MapHead": {}, "GSMapHead": GSMAP}[kind]
    head, memory = with_memory(**config)
    alone = {
        (scene, number): step(head, memory, meta(number, scene), feats=features(10 * seed + number))
        for seed, scene in enumerate("ab")
        for number in range(3)
    }
    memory.eval()  # forgets
    for number in range(3):
        both = torch.cat([features(number), features(10 + number)])
        found = step(head, memory, meta(number), meta(number, "b"), feats=both)
        for index, scene in enumerate("ab"):
            torch.testing.assert_close(found[index], alone[scene, number][0])


def test_the_memory_counts_and_a_new_scene_or_a_gap_forgets_it():
    head, memory = with_memory()
    fresh = step(head, memory, meta(1), feats=features(1))
    memory.eval()
    step(head, memory, meta(0), feats=features(0))
    assert not torch.allclose(step(head, memory, meta(1), feats=features(1)), fresh)
    other = meta(1, "b")
    torch.testing.assert_close(step(head, memory, other, feats=features(1)), fresh)
    later = meta(9, timestamp_ns=20 * HALF_S, lidar2global=meta(1)["lidar2global"])
    torch.testing.assert_close(step(head, memory, later, feats=features(1)), fresh)


@pytest.mark.parametrize(("again", "what"), [(1, "comes twice"), (0, "comes too late")])
def test_a_frame_out_of_order_is_named_with_the_one_before(again, what):
    head, memory = with_memory()
    for number in range(2):
        step(head, memory, meta(number))
    with pytest.raises(ValueError, match=f"'a{again}' .*{what}: its stream is at 'a1'"):
        step(head, memory, meta(again))


def test_two_frames_of_a_scene_do_not_share_a_batch():
    head, memory = with_memory()
    with pytest.raises(ValueError, match=r"'a0' .* and 'a1' .* of one scene are in one batch"):
        step(head, memory, meta(0), meta(1))


def test_a_stream_of_ones_own_refuses_another_scene():
    head, memory = with_memory()
    stream = MapStream()
    with memory.using(stream):
        step(head, memory, meta(0))
        with pytest.raises(ValueError, match=r"'b1' .* another scene than 'a0'"):
            step(head, memory, meta(1, "b"))
    assert stream.last.token == "a0"
    step(head, memory, meta(0))  # the detector's own streams know nothing of it


def test_the_first_batch_of_a_stream_of_ones_own_has_one_scene_too():
    head, memory = with_memory()
    with (
        memory.using(MapStream()),
        pytest.raises(ValueError, match=r"'b0' .* another scene than 'a0'"),
    ):
        step(head, memory, meta(0), meta(0, "b"))


@pytest.mark.parametrize("again", [copy.deepcopy, lambda it: pickle.loads(pickle.dumps(it))])
def test_a_copy_of_a_stream_goes_on_from_where_it_was(again):
    """It holds the frame and its state: none of the model's weights."""
    head, memory = with_memory()
    stream = memory.new_stream()
    with memory.using(stream):
        step(head, memory, meta(0), feats=features(0))
        copied = again(stream)
        whole = step(head, memory, meta(1), feats=features(1))
    assert copied.owner == str(memory)
    assert copied.last.token == "a0"
    with memory.using(copied):
        assert torch.equal(step(head, memory, meta(1), feats=features(1)), whole)
        with pytest.raises(ValueError, match=r"'a1' .*comes twice: its stream is at 'a1'"):
            step(head, memory, meta(1))
    _, other = with_memory()
    other.name = "b.py with b.pth"
    with (
        pytest.raises(ValueError, match=r"to a model with MapHead, and b\.py with b\.pth cannot"),
        other.using(again(stream)),
    ):
        pass


def test_a_stream_of_one_model_is_refused_by_another_and_both_are_named():
    (head, memory), (_, other) = with_memory(), with_memory()
    memory.name, other.name = "a.py with a.pth", "b.py with b.pth"
    stream, unused = memory.new_stream(), MapStream()
    with memory.using(stream):
        step(head, memory, meta(0))
    refusal = r"belongs to a\.py with a\.pth, and b\.py with b\.pth cannot read"
    with pytest.raises(ValueError, match=refusal), other.using(stream):
        pass
    with other.using(unused), pytest.raises(ValueError, match=r"to b\.py .* a\.py .*new_stream"):
        unused.claim(memory)


def test_a_failed_batch_leaves_the_stream_where_it_was():
    head, memory = with_memory()
    step(head, memory, meta(0))
    with pytest.raises(RuntimeError, match="on the way"), memory.remember_batch(bev(1), [meta(1)]):
        raise RuntimeError("on the way")
    step(head, memory, meta(1))


def test_a_sample_without_a_pose_is_named():
    head, memory = with_memory()
    with pytest.raises(ValueError, match=r"'a0' has no \['lidar2global'\]"):
        step(head, memory, meta(0, lidar2global=None))
    scaled, mirrored, sheared = (np.eye(4) for _ in range(3))
    scaled[:3, :3] *= 2.0
    mirrored[0, 0] = -1.0
    sheared[3, 0] = 1.0
    for wrong in (np.full((4, 4), np.nan), np.eye(3), scaled, mirrored, sheared):
        with pytest.raises(ValueError, match=r"lidar2global of sample 'a0' must be a finite"):
            step(head, memory, meta(0, lidar2global=wrong))


@pytest.mark.parametrize("time", [1.6e9, np.float64(1.6e18), None, "0"])
def test_a_time_that_is_no_integer_is_refused(time):
    with pytest.raises(TypeError, match="timestamp_ns of sample 'a' must be an integer of nanosec"):
        Frame("a", "scene", time, np.eye(4))


@pytest.mark.parametrize("kind", [np.int64, np.uint64, np.array, torch.tensor])
def test_a_time_of_any_integer_type_is_compared(kind):
    scenes = Scenes(max_gap_s=2.0)
    scenes.keep([StreamState(Frame("a", "scene", kind(7), np.eye(4)))])
    with pytest.raises(ValueError, match="comes too late"):
        scenes.previous([Frame("b", "scene", kind(6), np.eye(4))])


def test_slots_start_anew_where_a_sample_does_not_follow():
    slots = Slots(max_gap_s=2.0)
    slots.keep([StreamState(Frame.from_meta(meta(4, scene))) for scene in "abcd"])
    frames = [meta(5), meta(5, "x"), meta(3, "c"), meta(9, "d")]
    found = slots.previous([Frame.from_meta(each) for each in frames])
    assert [state is not None for state in found] == [True, False, False, False]


def test_only_the_latest_scenes_are_kept():
    scenes = Scenes(2.0, max_streams=2)
    for scene in "abc":
        scenes.keep([StreamState(Frame.from_meta(meta(0, scene)))])
    assert list(scenes.states) == ["b", "c"]


def test_a_standing_vehicle_keeps_its_memory_and_a_driving_one_moves_it():
    """Cells are 6 m x 6 m: driving 6 m ahead (y) moves what was in row 7 to row 6."""
    memory = BEVMemory(ALONG_Y, embed_dims=16)
    feats = features(0)
    still = torch.eye(4, dtype=torch.float64)[None]
    torch.testing.assert_close(memory.warp(feats, still), feats, atol=1e-5, rtol=0)
    ahead = still.clone()
    ahead[:, 1, 3] = 6.0  # metres now to metres then
    moved = memory.warp(feats, ahead)
    torch.testing.assert_close(moved[:, :, :-1], feats[:, :, 1:], atol=1e-5, rtol=0)
    assert moved[:, :, -1].abs().max() < 1e-5  # nothing was seen there
    released = BEVMemory(ALONG_Y, embed_dims=16, end_points=True)
    assert (released.warp(feats, still) - feats).abs().max() > 0.1


def test_channels_that_are_not_kept_are_those_of_now():
    """The vehicle stands, so the memory lies where it was."""
    memory = BEVMemory(ALONG_Y, embed_dims=16, kept_dims=4)
    before, now = features(0), features(1)
    kept = memory.remember(before)
    torch.testing.assert_close(kept, before[:, :4])
    still = torch.eye(4, dtype=torch.float64)[None], torch.ones(1), torch.ones(1, dtype=torch.bool)
    found = memory(now, Past({"bev_feats": kept}, *still))
    memory.kept_dims = None
    joined = torch.cat([kept, now[:, 4:]], 1)
    expected = memory(now, Past({"bev_feats": joined}, *still))
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=0)
    assert not torch.allclose(found, memory(now, Past({"bev_feats": before}, *still)))


def test_a_memory_that_starts_as_a_mean_leaves_a_first_frame_alone_and_learns():
    """The vehicle stands: what comes out is the mean, at the start, of present and past."""
    memory = BEVMemory(ALONG_Y, embed_dims=16, present_share=0.9)
    before, now = features(0), features(1)
    still = torch.eye(4, dtype=torch.float64)[None], torch.ones(1)
    first = Past({}, *still, torch.zeros(1, dtype=torch.bool))
    torch.testing.assert_close(memory(now, first), now)
    past = Past({"bev_feats": before}, *still, torch.ones(1, dtype=torch.bool))
    found = memory(now, past)
    torch.testing.assert_close(found, 0.9 * now + 0.1 * before, atol=1e-5, rtol=0)
    found.square().sum().backward()
    for part in (memory.convz.weight, memory.convz.bias, memory.convq.weight):
        assert part.grad.abs().max() > 0
    with pytest.raises(ValueError, match=r"present_share must lie between 0 and 1, got 1"):
        BEVMemory(ALONG_Y, embed_dims=16, present_share=1)


def test_a_model_without_memory_is_a_start_for_one_that_begins_as_a_mean_only():
    single = build_small().state_dict()
    settings = {"queries": {"num": 2}, "embed_dims": 16}
    fresh = build_small(temporal={"bev": {"present_share": 0.9}, **settings})
    fresh.load_state_dict(single)
    fresh.allow_untrained = False
    with pytest.raises(ValueError, match=r"never trained with .*temporal\.bev\.convq"):
        fresh.load_state_dict(single)
    published = build_small(temporal={"bev": {}, **settings})
    with pytest.raises(ValueError, match=r"does not fit the model; missing: temporal\.bev\.conv"):
        published.load_state_dict(single)


def test_half_a_state_keeps_the_places_exact():
    head, memory = with_memory()
    whole = [step(head, memory, meta(n), feats=features(n)) for n in range(2)]
    values = memory.streams.states["a"].values
    assert {name: value.dtype for name, value in values.items()} == dict.fromkeys(
        ("bev_feats", "queries_0", "queries_1", "references"), torch.float32
    )
    memory.eval().half = True
    halved = [step(head, memory, meta(n), feats=features(n)) for n in range(2)]
    assert torch.equal(halved[0], whole[0])
    assert 0 < (halved[1] - whole[1]).abs().max() < 1e-3  # of the map's sides
    kinds = [value.dtype for value in memory.streams.states["a"].values.values()]
    assert kinds == [torch.float16] * 3 + [torch.float32]


def test_references_move_with_the_vehicle():
    """The vehicle turned left by 90 degrees: what was ahead is now to the right, the line turns."""
    head = build_head(GSMAP)
    motion = torch.as_tensor(np.linalg.inv(pose(0.0, math.pi / 2)))[None]
    ahead = head.reference.norm(torch.tensor([[0.0, 6.0]]))
    reference = torch.cat([ahead, torch.tensor([[0.3, 0.2, 0.1]])], -1)[None]
    moved = head.reference.transform_references(reference, motion)
    assert head.reference.metres(moved[0, 0, :2]).tolist() == pytest.approx([6.0, 0.0], abs=1e-4)
    before, after = (head.reference.space.decode(r).rotations for r in (reference, moved))
    assert float(after - before) == pytest.approx(-math.pi / 2, abs=1e-5)


def test_training_gives_every_weight_a_gradient_and_later_frames_a_loss():
    head, memory = with_memory()
    head.train(), memory.train()
    losses, shares = [], []
    for number in range(2):
        with memory.remember_batch({"bev_feats": features(number)}, [meta(number)]) as batch:
            sample = make_samples(LANES)[0]
            sample.set_metainfo(meta(number))
            each = head.loss(batch.outputs, [sample], **batch.hooks)
        losses.append(each["loss_trans"])
        shares.append(sum(value for name, value in each.items() if "loss" in name))
    assert float(losses[0]) == 0
    assert float(losses[1]) > 0
    shares[0].backward()
    assert all(p.grad is not None for p in memory.parameters())  # as DDP needs
    head.zero_grad(), memory.zero_grad()
    shares[1].backward()
    moved = [float(p.grad.abs().sum()) for p in memory.queries.parameters()]
    assert all(value > 0 for value in moved)


@pytest.mark.parametrize("config", [HEAD, {**GSMAP, "loss_raster": None, "iou_cost": None}])
def test_a_query_that_has_moved_as_the_vehicle_has_no_loss(config):
    """Targets of the frame before, after a turn of half a circle, lie where they are predicted."""
    head, memory = with_memory(**config)
    head.train(), memory.train()
    start, turned = (meta(n, lidar2global=pose(0.0, n * math.pi)) for n in range(2))
    with memory.remember_batch({"bev_feats": features(0)}, [start]) as batch:
        (sample,) = make_samples(LANES)
        head.loss(batch.outputs, [sample], **batch.hooks)
    past = stack_past([Frame.from_meta(turned)], memory.streams.states, torch.device("cpu"))
    batch = memory.recall({"bev_feats": features(1)}, past)
    head(batch.outputs, **batch.hooks)
    propagation = batch.propagation
    assert float(propagation.loss(head)) > 0.1
    state, _, reference = (leaf.flatten(1, 2) for leaf in propagation.propagated)
    predicted = head.reference.refine(0, state, reference)[..., :2].detach()
    targets = head.reference.transform_points(predicted, past.then_from_now).view(1, 2, 5, 2)
    memories = {**past.memory, "targets": targets}
    propagation.past = Past(memories, past.now_from_then, past.seconds, past.continues)
    assert float(propagation.loss(head)) < 1e-6


def test_further_query_groups_keep_their_queries():
    groups = [{"num": 4}, {"name": "one2many", "num": 6, "repeats": 2}]
    head, memory = with_memory(query_groups=groups)
    head.train(), memory.train()
    for number in range(2):
        with memory.remember_batch({"bev_feats": features(number)}, [meta(number)]) as batch:
            head(batch.outputs, **batch.hooks)
            propagation = batch.propagation
            if number == 0:
                propagation.target_pts = torch.zeros(1, 10, 5, 2)
    order = propagation.order(torch.zeros(1, 4), total=10)
    assert order[0, :2].tolist() == [0, 1]
    assert sorted(order[0, 2:4].tolist()) < [6, 6]
    assert order[0, 4:].tolist() == list(range(6, 12))


def test_a_memory_that_does_not_fit_is_refused():
    head = build_head(HEAD)
    with pytest.raises(ValueError, match="bev=dict"):
        StreamMemory(head)
    with pytest.raises(ValueError, match="a memory of 4 queries does not fit a head of 4 queries"):
        StreamMemory(head, queries={"num": 4})
    with pytest.raises(ValueError, match=r"kept_dims must be 1 to 16, .* got 17"):
        StreamMemory(head, bev={"kept_dims": 17}, embed_dims=16)
    with pytest.raises(ValueError, match=r"max_gap_s must be seconds > 0, got 0"):
        StreamMemory(head, bev={}, max_gap_s=0)
    wide = StreamMemory(head, bev={}, embed_dims=32)
    with pytest.raises(ValueError, match="16 channels, and their memory has 32: set temporal"):
        step(head, wide.eval(), meta(0))
    single = build_head(HEAD, decoder={**HEAD["decoder"], "num_layers": 1})
    with pytest.raises(ValueError, match=r"set map_head\.decoder\.num_layers to 2 or more"):
        StreamMemory(single, queries={"num": 2})


def test_a_detector_remembers():
    model = build_small(temporal={"bev": {}, "queries": {"num": 3}, "embed_dims": 16}).eval()
    images = make_images(1)
    found = []
    for number in (0, 1):
        (sample,) = make_samples(straight_elements())
        sample.set_metainfo(meta(number))
        with torch.no_grad():
            (result,) = model.predict(copy.deepcopy(images), [sample])
        assert isinstance(result.pred_instances_3d, InstanceData)
        found.append(result.pred_instances_3d.pts)
    assert not torch.allclose(*found)  # the images are the same, the memory is not
