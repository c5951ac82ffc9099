"""Steps of images on a device equal the published ones of the host."""

import cv2
import numpy as np
import pytest
import torch
from mmcv.transforms import Compose
from mmdet3d.registry import MODELS, TRANSFORMS
from mmengine.config import ConfigDict
from mmengine.registry import init_default_scope
from PIL import Image

import gsmap.registered  # noqa: F401
from gsmap.datasets.transforms.image_steps import CropTop, Distortion, Resize
from gsmap.engine.launch import read_config

LOAD = {"type": "LoadCameraImages"}
ON_DEVICE = {**LOAD, "on_device": True}
DISTORT = {"type": "DistortImages"}
SCALE = {"type": "ScaleImages", "scale": 0.5}
CROP = {"type": "CropImages", "top": 6}
PACK = {"type": "PackMapInputs"}
PUBLISHED = {
    "type": "MultiViewWrapper",
    "transforms": [{"type": "PhotoMetricDistortion3D"}],
    "override_aug_config": False,
    "collected_keys": [],
}
GREY_LEVELS = 0.01  # float32 arithmetic in another order, of values up to some 400


def sample_of(seed, shapes=((54, 96), (54, 96), (54, 96))):
    """Return what a pipeline starts from: smooth and noisy pictures in memory."""
    generator = np.random.default_rng(seed)
    images = {}
    for number, shape in enumerate(shapes):
        image = generator.integers(0, 256, (*shape, 3), np.uint8)
        if number:
            image = cv2.GaussianBlur(image, (0, 0), 3.0 * number)
        images[f"CAM_{number}"] = {
            "img_path": image,
            "cam2img": np.eye(4),
            "lidar2cam": np.eye(4),
        }
    return {"images": images, "token": f"t{seed}", "cam_names": list(images)}


def run_pipeline(steps, seed, **options):
    init_default_scope("mmdet3d")
    np.random.seed(seed)  # noqa: NPY002  what mmdet draws from
    return Compose([TRANSFORMS.build(step) for step in steps])(sample_of(seed, **options))


def run_on(load, steps, seeds):
    """Return what a pipeline makes of the samples of several seeds."""
    return [run_pipeline([load, *steps, PACK], seed) for seed in range(seeds)]


def collate(*items, device="cpu"):
    images = [item["inputs"]["img"] for item in items]
    samples = [item["data_samples"] for item in items]
    data = {"inputs": {"img": images}, "data_samples": samples}
    preprocessor = {"type": "MapDataPreprocessor", "pad_size_divisor": 32}
    return MODELS.build(preprocessor).to(device)(data)["inputs"]["imgs"]


@pytest.mark.parametrize("seed", range(12))
def test_distortion_is_that_of_mmdet3d(seed):
    ours = run_pipeline([{**LOAD, "to_float32": False}, DISTORT, SCALE, PACK], seed)
    published = run_pipeline([LOAD, PUBLISHED, SCALE, PACK], seed)
    assert torch.equal(ours["inputs"]["img"], published["inputs"]["img"])


@pytest.mark.parametrize(
    "steps", [[DISTORT, SCALE], [SCALE, DISTORT], [SCALE], [CROP, SCALE], [DISTORT, SCALE, CROP]]
)
def test_a_batch_on_the_device_equals_that_of_the_host(steps):
    on_host = run_on(LOAD, steps, seeds=24)
    noted = run_on(ON_DEVICE, steps, seeds=24)
    assert {item["inputs"]["img"].dtype for item in noted} == {torch.uint8}
    for ours, theirs in zip(noted, on_host, strict=True):
        for name in ("lidar2img", "img_aug_matrix"):
            np.testing.assert_array_equal(
                ours["data_samples"].metainfo[name], theirs["data_samples"].metainfo[name]
            )
        assert ours["data_samples"].img_shape == theirs["data_samples"].img_shape
    expected = collate(*on_host)
    torch.testing.assert_close(collate(*noted), expected, atol=GREY_LEVELS, rtol=0)


def test_bicubic_scaling_is_pillows():
    """As released code scales: antialiased, so that no pixel is left out, to whole grey levels."""
    scale = {"type": "ScaleImages", "size": (21, 8), "kernel": "bicubic"}
    images = sample_of(3)["images"]
    wanted = []
    for camera in images.values():
        image = Image.fromarray(camera["img_path"])
        wanted.append(np.asarray(image.resize((21, 8))))  # Pillow's own default
    for load in ({**LOAD, "to_float32": False}, LOAD):  # floats that are whole
        found = run_pipeline([load, scale, PACK], 3)["inputs"]["img"]  # (V, 3, H, W)
        assert np.array_equal(found.permute(0, 2, 3, 1).numpy(), np.stack(wanted))
    bilinear = run_pipeline([LOAD, {**scale, "kernel": "bilinear"}, PACK], 3)["inputs"]["img"]
    noise = images["CAM_0"]["img_path"].astype(float)
    assert bilinear[0].std() > 0.4 * noise.std() > wanted[0].std()  # pixels left out keep noise


@pytest.mark.parametrize("size", [(21, 8), (200, 111), (96, 54), (40, 100)])
def test_bicubic_scaling_on_the_device_equals_pillows_to_a_grey_level(size):
    scale = {"type": "ScaleImages", "size": size, "kernel": "bicubic"}
    on_host = collate(*run_on(LOAD, [scale], seeds=4))
    noted = collate(*run_on(ON_DEVICE, [scale], seeds=4))
    apart = (noted - on_host).abs()
    assert apart.max() <= 1.0  # a tie between two levels; Pillow rounds its weights to 22 bits
    assert (apart > 0).float().mean() < 0.01


def test_an_unknown_kernel_is_refused():
    with pytest.raises(ValueError, match=r"kernel must be one of .*bicubic.*got 'lanczos'"):
        TRANSFORMS.build({"type": "ScaleImages", "scale": 0.5, "kernel": "lanczos"})


def distortion_numbers(step, seeds):
    """Return the numbers that are drawn for each image of some samples."""
    numbers = []
    for item in run_on(ON_DEVICE, [step], seeds):
        numbers += item["data_samples"].image_steps[0].numbers
    return numbers


def test_channels_stay_where_no_swap_is_asked_for():
    """Only the swap goes: all other numbers are those that are drawn with it."""
    without_swap = {**DISTORT, "swap_channels": False}
    swapped = distortion_numbers(DISTORT, seeds=8)
    kept = distortion_numbers(without_swap, seeds=8)
    for with_swap, without in zip(swapped, kept, strict=True):
        assert without[5] == 0
        assert repr(with_swap[:5] + with_swap[6:]) == repr(without[:5] + without[6:])
    found = run_pipeline([LOAD, without_swap, PACK], 0)
    wanted = run_pipeline([ON_DEVICE, without_swap, PACK], 0)
    torch.testing.assert_close(collate(wanted), collate(found), atol=GREY_LEVELS, rtol=0)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_a_batch_on_a_gpu_equals_that_of_the_host():
    steps = [DISTORT, SCALE]
    on_host = run_on(LOAD, steps, seeds=24)
    noted = run_on(ON_DEVICE, steps, seeds=24)
    found = collate(*noted, device="cuda")
    torch.testing.assert_close(found.cpu(), collate(*on_host), atol=GREY_LEVELS, rtol=0)


def test_every_branch_of_the_distortion_was_compared():
    """The numbers of 24 samples of three images hold each flag, both orders and all sectors."""
    rows = distortion_numbers(DISTORT, seeds=24)
    for column in range(6):
        assert {row[column] for row in rows} == {0, 1}


def test_samples_of_different_steps_are_computed_one_by_one():
    other_scale = {"type": "ScaleImages", "size": (48, 27)}
    items = []
    for steps in ([SCALE], [other_scale], [SCALE, DISTORT]):
        items.append(run_pipeline([ON_DEVICE, *steps, PACK], 0))
    together = collate(*items)
    for row, item in zip(together, items, strict=True):
        assert torch.equal(row, collate(item)[0])


def test_whole_grey_levels_stay_whole():
    """MiniCity scales uint8; a half is rounded up."""
    load = {**LOAD, "to_float32": False}
    on_host = run_pipeline([load, SCALE, PACK], 3)
    noted = run_pipeline([{**load, "on_device": True}, SCALE, PACK], 3)
    assert torch.equal(collate(noted), collate(on_host))


def test_images_of_several_sizes_are_scaled_on_the_host():
    scale = {"type": "ScaleImages", "size": (48, 27)}
    shapes = ((54, 96), (60, 80))
    ours = run_pipeline([ON_DEVICE, scale, DISTORT, PACK], 1, shapes=shapes)
    theirs = run_pipeline([LOAD, scale, DISTORT, PACK], 1, shapes=shapes)
    assert torch.equal(ours["inputs"]["img"], theirs["inputs"]["img"])


def test_transforms_that_read_pixels_get_them():
    corrupt = {"type": "CorruptImages", "kind": "camera_lost", "severity": 1}
    ours = run_pipeline([ON_DEVICE, SCALE, corrupt, PACK], 1)
    theirs = run_pipeline([LOAD, SCALE, corrupt, PACK], 1)
    assert torch.equal(ours["inputs"]["img"], theirs["inputs"]["img"])


def test_steps_join_only_with_their_like():
    row = (0, 1, 1, 1, 1, 1, 3.0, 1.1, 0.9, 5.0, (2, 0, 1))
    assert Resize((4, 3)).join([Resize((4, 3))]) == Resize((4, 3))
    assert Resize((4, 3)).join([Resize((4, 4))]) is None
    assert CropTop(2).join([CropTop(3)]) is None
    assert Distortion((row,)).join([Distortion((row, row))]) == Distortion((row,) * 3)
    assert Distortion((row,)).join([CropTop(3)]) is None


def test_a_switch_of_the_config_leaves_pixels_to_the_device(tmp_path):
    config = "configs/maptr/maptr_r50_24e.py"
    cfg = read_config(config, {"images_on_device": True})
    for loader in (cfg.train_dataloader, cfg.test_dataloader):
        assert loader.pin_memory
        assert loader.dataset.pipeline[0].on_device
    assert not read_config(config).train_dataloader.dataset.pipeline[0].get("on_device")
    cfg.train_dataloader.dataset.pipeline[1] = ConfigDict(PUBLISHED)
    with pytest.raises(ValueError, match="MultiViewWrapper, which reads pixels on the host: take"):
        read_config(cfg)


def test_workers_are_as_many_as_cores(monkeypatch):
    config = "configs/maptr/maptr_r50_24e.py"
    for cores, ranks, workers in ((8, 1, 8), (64, 2, 16), (4, 8, 1)):
        monkeypatch.setattr("os.sched_getaffinity", lambda _, cores=cores: set(range(cores)))
        monkeypatch.setenv("LOCAL_WORLD_SIZE", str(ranks))
        assert read_config(config).train_dataloader.num_workers == workers
