"""A prior for images in memory."""

import cv2
import numpy as np
import pytest
import torch
from inferencer_cases import make_config, make_samples
from mmengine.config import ConfigDict
from prior_cases import CLASSES, pose_at

from gsmap.apis.map_inferencer import MapInferencer
from gsmap.prior import LastSeen, MapPrior, PriorSettings
from gsmap.structures.streams import Frame

HERE = Frame("a", "scene", 0, pose_at(0.0))


@pytest.fixture(scope="module")
def inferencer() -> MapInferencer:
    cfg = make_config()
    cfg.model.prior = ConfigDict(
        type="RasterPrior",
        cell_m=1.5,
        score_threshold=0.0,
        bev={"layer": None, "threshold": 0.1},
        queries={"num_heads": 4, "stride": 1, "threshold": 0.1},
    )
    torch.manual_seed(0)
    return MapInferencer(cfg, None, device="cpu")


@pytest.fixture
def rig(tmp_path):
    """Images, intrinsics and transforms of a frame."""
    (sample,) = make_samples(tmp_path, 1)
    images = {c.name: cv2.imread(str(tmp_path / c.path))[..., ::-1] for c in sample.cameras}
    intrinsics = {c.name: c.intrinsics for c in sample.cameras}
    return images, intrinsics, {c.name: c.cam_from_frame for c in sample.cameras}


def empty_prior(cell_m=1.5) -> MapPrior:
    return MapPrior(PriorSettings(CLASSES, "town", cell_m=cell_m), LastSeen())


def test_a_live_map_reads_and_updates_a_prior(inferencer, rig, caplog):
    images, *calibration = rig
    prior = empty_prior()
    new = inferencer.live(*calibration, frame="lidar", prior=empty_prior(), update_prior=True)
    new(images, at=HERE)
    assert "nothing in the range" not in caplog.text  # it is being made
    reading = inferencer.live(*calibration, frame="lidar", prior=prior)
    first = reading(images, at=HERE)
    assert "the prior of 'town' has nothing in the range of a frame" in caplog.text
    assert prior.num_tiles == 0
    writing = inferencer.live(*calibration, frame="lidar", prior=prior, update_prior=True)
    np.testing.assert_array_equal(writing(images, at=HERE).points, first.points)
    assert prior.num_tiles > 0
    assert not np.array_equal(reading(images, at=HERE).points, first.points)
    far = Frame("a", "scene", 0, pose_at(1000.0))
    np.testing.assert_array_equal(reading(images, at=far).points, first.points)
    alone = inferencer.live(*calibration, frame="lidar")  # without a prior, nothing is kept
    np.testing.assert_array_equal(alone(images).points, first.points)
    np.testing.assert_array_equal(alone(images).points, first.points)


def test_wrong_priors_are_refused(inferencer, rig):
    images, *calibration = rig
    live = inferencer.live(*calibration, frame="lidar", prior=empty_prior())
    with pytest.raises(ValueError, match="a frame reads the prior at its pose"):
        live(images)
    with pytest.raises(ValueError, match=r"has cell_m 0\.3, and 1\.5 is needed"):
        inferencer.live(*calibration, prior=empty_prior(cell_m=0.3))
    with pytest.raises(ValueError, match="needs both at="):
        inferencer.live(*calibration, frame="lidar")(images, at=HERE)
    torch.manual_seed(0)
    plain = MapInferencer(make_config(), None, device="cpu")
    with pytest.raises(ValueError, match="the model takes no prior"):
        plain.live(*calibration, prior=empty_prior())
    with pytest.raises(ValueError, match=r"cuda_graphs|GPU"):
        MapInferencer(inferencer.cfg, None, device="cpu", cuda_graphs=True)
