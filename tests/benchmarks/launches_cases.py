"""A GPU that is not there: what it refuses and counts, and that every config trains on it.

The budgets hold what was reached: a launch costs a GPU's host some 20 microseconds.
"""

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from model_cases import IMAGE_SHAPE, NUM_CAMS
from test_configs import load, small
from torch import nn

from benchmarks.launches import Trial
from benchmarks.model import ring_of_cameras
from benchmarks.pretended_gpu import DEVICE, NAME, PretendedGPU, available
from gsmap.apis.fast_frame import StaticFrame
from gsmap.apis.map_inferencer import MapInferencer
from gsmap.ops import backends
from gsmap.structures.tensors import LateValues, constant, upload

pytestmark = pytest.mark.skipif(not available(), reason="torch has no backends in Python")
REPO = Path(__file__).resolve().parents[2]
SIZE = (64, 96)
TIED = ("PivotBEVEncoder", "ViewTransformEncoder", "HeightPlanesEncoder")  # to the images' size
SMALL = sorted(
    path
    for folder in ("configs", "projects/GSMap/configs")
    for path in (REPO / folder).rglob("*_minicity.py")
    if "_base_" not in path.parts and path.stem != "maptr_pointpillars_minicity"  # has no images
)
GSMAP = REPO / "projects/GSMap/configs/gsmap_maptr_r18_minicity.py"
MAPTR = REPO / "configs/maptr/maptr_r18_minicity.py"


ENCODERS = {
    "GKT": {},
    "BEVFormer": {
        "cross_attn": {
            "_delete_": True,
            "type": "SpatialCrossAttention",
            "num_heads": 4,
            "num_points": 8,
            "num_heights": 4,
        }
    },
    "LSS": {
        "_delete_": True,
        "type": "LSSEncoder",
        "bev_pixel_m": 1.2,
        "embed_dims": 128,
        "camera_aware": False,
    },
}


@pytest.fixture
def gpu() -> Iterator[PretendedGPU]:
    with PretendedGPU() as entered:
        yield entered


def waits(gpu: PretendedGPU) -> list[str]:
    return [reason for (_, reason, _), times in gpu.waits.items() for _ in range(times)]


def test_tensors_of_two_devices_are_refused(gpu):
    there = torch.ones(3).to(DEVICE)
    with pytest.raises(RuntimeError, match=r"same device, but found .* pretended:0 and cpu"):
        there + torch.ones(3)
    with pytest.raises(RuntimeError, match="indices should be either on cpu or on the same device"):
        torch.ones(3)[torch.tensor([1]).to(DEVICE)]
    with pytest.raises(TypeError, match=r"numpy: use Tensor\.cpu\(\)"):
        there.numpy()
    assert (there * torch.tensor(2.0)).sum().item() == 6.0  # single numbers may be anywhere


def test_a_tensor_is_of_no_use_outside(gpu):
    there = torch.ones(3).to(DEVICE)
    gpu.__exit__(None, None, None)
    with pytest.raises(RuntimeError, match="outside of PretendedGPU"):
        there + 1
    gpu.__enter__()


def test_waits_are_counted_with_their_line(gpu):
    there = torch.arange(4.0).to(DEVICE)
    there.tolist()
    there[there > 1]
    there.nonzero()
    there[[2, 1]]
    there[torch.tensor([2, 1])]
    torch.tensor([1.0, 2.0], device=DEVICE)
    there.new_tensor([1.0])
    bool(there.sum() > 3)
    assert waits(gpu) == [
        "upload", "download", "boolean index", "nonzero", "upload", "upload of an index", "upload",
        "upload", "_local_scalar_dense",
    ]  # fmt: skip
    lines = {line.partition(":")[0] for _, _, line in gpu.waits}
    assert lines == {"tests/benchmarks/launches_cases.py"}


def test_what_does_not_wait(gpu):
    there, again = upload([torch.ones(2), torch.arange(3)], torch.device(DEVICE))
    assert again.cpu().tolist() == [0, 1, 2]
    constant(there, [1.0, 2.5])
    gpu.clear()
    product = there * constant(there, [1.0, 2.5])
    late = LateValues(product)
    product.view(2, 1).t().clamp(min=0)
    assert late.read().tolist() == [1.0, 2.5]
    assert not gpu.waits
    assert {name for _, name in gpu.launches} == {"mul.Tensor", "clamp", "download"}


def test_gradients_are_those_of_the_cpu_and_count_as_their_part(gpu):
    torch.manual_seed(0)
    net = nn.Sequential(nn.Linear(3, 4), nn.ReLU(), nn.MultiheadAttention(4, 2, batch_first=True))
    inputs = torch.randn(2, 5, 3)

    def loss(x: torch.Tensor) -> torch.Tensor:
        with gpu.part("first"):
            hidden = net[1](net[0](x))
        with gpu.part("second"):
            return net[2](hidden, hidden, hidden, need_weights=False)[0].square().mean()

    loss(inputs).backward()
    expected = [p.grad.clone() for p in net.parameters()]
    net.to(DEVICE)
    net.zero_grad()
    gpu.clear()
    total = loss(inputs.to(DEVICE))
    with gpu.backward():
        total.backward()
    for parameter, wanted in zip(net.parameters(), expected, strict=True):
        torch.testing.assert_close(parameter.grad.cpu(), wanted)
    parts = {part for part, _ in gpu.launches}
    assert {"first", "second", "backward: first", "backward: second"} <= parts
    assert gpu.launches["second", "_scaled_dot_product_efficient_attention"] == 1


def test_nothing_stays_changed_after_it():
    before = dict(backends.DEVICES)
    with PretendedGPU():
        assert backends.DEVICES["triton"] == NAME
    assert before == backends.DEVICES
    assert not torch.__future__.get_overwrite_module_params_on_conversion()


@pytest.mark.parametrize("path", SMALL, ids=lambda path: path.stem)
def test_every_config_trains_and_predicts_on_a_gpu(path):
    cfg = small(load(path))
    encoder = cfg.model.get("bev_encoder") or {}
    trial = Trial(cfg, None if encoder.get("type") in TIED else SIZE, batch=2)
    with trial.gpu:
        trial.model.to(DEVICE)
        before = {name: value.host.clone() for name, value in trial.model.named_parameters()}
        figures = trial.step()
        weights = dict(trial.model.named_parameters())
        assert not [name for name, weight in weights.items() if weight.device.type != NAME]
        assert all(weight.host.isfinite().all() for weight in weights.values())
        changed = [name for name in weights if not torch.equal(weights[name].host, before[name])]
        assert {name.partition(".")[0] for name in changed} >= {"img_backbone", "map_head"}
        assert figures["loss"].item() > 0
        trial.model.loss_check.finish()
        if type(trial.model.map_head).__name__ == "VectorMapNetHead":
            return  # it draws from a torch.Generator, which torch's backends in Python do not have
        found = trial.frame().pred_instances_3d
    assert len(found.scores_3d) == len(found.labels_3d)


# what was reached: launches of a step of two samples and of a frame, without kernels that no GPU
# has run yet
BUDGETS = {MAPTR: (1310, 532), GSMAP: (1990, 589)}  # GridMask masks some steps


@pytest.mark.parametrize("path", BUDGETS, ids=lambda path: path.stem)
def test_launches_and_waits_stay_within_their_budgets(path, monkeypatch):
    monkeypatch.setattr(backends, "AUTO_KERNELS", {"pairwise_soft_iou", "render_gaussians"})
    trial = Trial(str(path), SIZE, batch=2)
    most_in_step, most_in_frame = BUDGETS[path]
    with trial.gpu:
        trial.step()  # makes what is kept
        trial.step()
        assert trial.gpu.launches.total() <= most_in_step
        assert trial.gpu.waits.total() <= 3
        trial.frame()
        trial.frame()
        assert trial.gpu.launches.total() <= most_in_frame
        assert trial.gpu.waits.total() <= 2


@pytest.mark.parametrize("encoder", ENCODERS)
@torch.no_grad()
def test_a_static_frame_never_waits_for_the_gpu(encoder):
    options = {f"model.bev_encoder.{key}": value for key, value in ENCODERS[encoder].items()}
    if "_delete_" in ENCODERS[encoder]:
        options = {"model.bev_encoder": ENCODERS[encoder]}
    model = MapInferencer(str(MAPTR), None, "cpu", options).model
    images = torch.randint(0, 255, (1, NUM_CAMS, 3, *IMAGE_SHAPE), dtype=torch.uint8)
    matrices = torch.from_numpy(ring_of_cameras(NUM_CAMS, *IMAGE_SHAPE)).float()[None]
    known = {"can_bus": torch.zeros(1, 18), "img_from_frame": matrices}
    known["frame_from_img"] = torch.linalg.inv(matrices)
    frame = StaticFrame(model)
    calibration = [known[name] for name in frame.names]
    expected = frame(images, *calibration)
    with PretendedGPU() as gpu:
        frame.to(DEVICE)
        inputs = [x.to(DEVICE) for x in (images, *calibration)]
        frame(*inputs)  # keeps constants
        gpu.clear()
        found = frame(*inputs)
        assert gpu.launches.total() > 100
        assert not gpu.waits
        torch.testing.assert_close(found.cpu(), expected)
