"""A whole batch at once gives what mmdet3d gives image by image, bit for bit."""

import copy

import pytest
import torch
from mmdet3d.registry import MODELS
from mmdet3d.structures import Det3DDataSample
from mmengine.structures import InstanceData

import gsmap.registered  # noqa: F401
from gsmap.datasets.transforms.image_steps import Resize

SETTINGS = {
    "mean": [123.675, 116.28, 103.53],
    "std": [58.395, 57.12, 57.375],
    "bgr_to_rgb": True,
    "pad_size_divisor": 32,
}
CASES = {
    "bytes": {},
    "floats": {"dtype": torch.float32},
    "not padded": {"sizes": [(64, 96)] * 2},
    "one sample": {"sizes": [(45, 80)]},
    "of different sizes": {"sizes": [(45, 80), (30, 70)]},
    "BGR": {"bgr_to_rgb": False},
    "another value of the margin": {"pad_value": 7},
    "not normalised": {"mean": None, "std": None},
}


def batch(dtype=torch.uint8, sizes=((45, 80), (45, 80))) -> dict:
    """Return what a data loader hands on: images, and samples with ground truth."""
    torch.manual_seed(0)
    images = [(torch.rand(6, 3, *size) * 255).to(dtype) for size in sizes]
    samples = []
    for number in range(len(sizes)):
        sample = Det3DDataSample(metainfo={"token": f"token {number}"})
        labels = torch.arange(number)
        sample.gt_instances_3d = InstanceData(labels_3d=labels, pts=torch.rand(number, 20, 2))
        sample.gt_seg = torch.rand(3, 4, 5).round()
        samples.append(sample)
    return {"inputs": {"img": images}, "data_samples": samples}


@pytest.mark.parametrize("case", CASES)
def test_results_are_mmdet3ds(case):
    given = dict(CASES[case])
    data = batch(**{name: given.pop(name) for name in ("dtype", "sizes") if name in given})
    before = copy.deepcopy(data)
    settings = {**SETTINGS, **given}
    ours, theirs = (
        MODELS.build({"type": kind, **settings})(copy.deepcopy(data), True)
        for kind in ("MapDataPreprocessor", "Det3DDataPreprocessor")
    )
    assert torch.equal(ours["inputs"]["imgs"], theirs["inputs"]["imgs"])
    for own, other in zip(ours["data_samples"], theirs["data_samples"], strict=True):
        assert own.metainfo == other.metainfo
        assert torch.equal(own.gt_instances_3d.pts, other.gt_instances_3d.pts)
        assert torch.equal(own.gt_seg, other.gt_seg)
    preprocessor = MODELS.build({"type": "MapDataPreprocessor", **settings})
    preprocessor(data, True)
    for image, old in zip(data["inputs"]["img"], before["inputs"]["img"], strict=True):
        assert torch.equal(image, old)  # the given images are left as they were


def test_it_has_no_state_of_its_own():
    assert not MODELS.build({"type": "MapDataPreprocessor", **SETTINGS}).state_dict()


@pytest.mark.parametrize("raw", [((48, 64), (24, 32)), ((48, 64), (48, 64))])
@pytest.mark.parametrize(
    ("finished", "padded"), [([(16, 12), (16, 12)], (12, 16)), ([(16, 12), (8, 6)], (12, 16))]
)
def test_deferred_steps_run_on_images_of_different_sizes(finished, padded, raw):
    """Two rigs, or a random scale: the images are stacked, or padded, after the steps."""
    images = [torch.full((2, 3, *size), 100, dtype=torch.uint8) for size in raw]
    samples = []
    for number, size in enumerate(finished):
        meta = {"token": f"token {number}", "image_steps": [Resize(size)]}
        samples.append(Det3DDataSample(metainfo=meta))
    preprocessor = MODELS.build(
        {"type": "MapDataPreprocessor", "mean": [0.0] * 3, "std": [1.0] * 3}
    )
    imgs = preprocessor({"inputs": {"img": images}, "data_samples": samples})["inputs"]["imgs"]
    assert imgs.shape == (2, 2, 3, *padded)
    for sample, (width, height) in zip(imgs, finished, strict=True):
        assert (sample[..., :height, :width] == 100).all()
        assert sample.sum() == 100 * 2 * 3 * height * width
