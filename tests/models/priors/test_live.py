"""Elements of earlier drives for images in memory."""

import cv2
import numpy as np
import pytest
import torch
from inferencer_cases import make_config, make_samples
from mmengine.config import ConfigDict
from prior_cases import CLASSES, pose_at

from gsmap.apis.map_inferencer import MapInferencer
from gsmap.prior import ElementPrior, PriorSettings
from gsmap.structures.elements import MapElements
from gsmap.structures.streams import Frame


def test_a_live_map_fuses_elements_and_refuses_to_write_at_its_start(tmp_path, caplog):
    cfg = make_config()
    cfg.model.prior = ConfigDict(type="ElementFusion")
    torch.manual_seed(0)
    inferencer = MapInferencer(cfg, None, device="cpu")
    (sample,) = make_samples(tmp_path, 1)
    images = {c.name: cv2.imread(str(tmp_path / c.path))[..., ::-1] for c in sample.cameras}
    intrinsics = {c.name: c.intrinsics for c in sample.cameras}
    cam_from_frame = {c.name: c.cam_from_frame for c in sample.cameras}
    line = np.array([[103.0, -20.0], [103.0, 20.0]])
    elements = MapElements.from_polylines([line], [2], scores=[0.75])
    prior = ElementPrior(PriorSettings(CLASSES, "town"), elements)
    live = inferencer.live(intrinsics, cam_from_frame, frame="lidar", prior=prior)
    found = live(images, at=Frame("a", "scene", 0, pose_at(100.0)))
    at_line = [np.abs(line[:, 0] - 3.0).max() < 1e-3 for line in found.polylines]
    assert sum(at_line) == 1
    assert "nothing in the range" not in caplog.text
    live(images, at=Frame("a", "scene", 0, pose_at(1000.0)))
    elsewhere = live(images, at=Frame("a", "scene", 0, pose_at(1000.0)))
    assert not any(np.abs(line[:, 0] - 3.0).max() < 1e-3 for line in elsewhere.polylines)
    assert caplog.text.count("the prior of 'town' has nothing in the range of a frame") == 1
    with pytest.raises(ValueError, match="has elements, which a model can only read"):
        inferencer.live(intrinsics, cam_from_frame, frame="lidar", prior=prior, update_prior=True)
    with pytest.raises(ValueError, match="there is no prior to update: give one"):
        inferencer.live(intrinsics, cam_from_frame, update_prior=True)
    for closed in ("town.prior", [prior]):
        with pytest.raises(TypeError, match=r"a prior is opened by .*open_prior\(FILE\), got"):
            inferencer.live(intrinsics, cam_from_frame, prior=closed)
    dataset = inferencer.dataset([sample], tmp_path)
    with pytest.raises(ValueError, match="there is no prior to update: give one"):
        next(inferencer.predict(dataset, update_priors=True))
