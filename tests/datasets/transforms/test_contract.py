"""The contract of all registered transforms of the plugin, each asked on one sample.

A new transform without a case fails. Transforms of methods have theirs in ``methods/<method>``.
"""

import copy
import pickle
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from method_cases import cases_of_methods
from mmdet3d.registry import TRANSFORMS
from mmdet3d.structures import BasePoints, Det3DDataSample, LiDARPoints
from mmengine.registry import init_default_scope
from mmengine.structures import InstanceData
from sample_cases import META, pose, sample

import gsmap.registered  # noqa: F401
from gsmap.datasets.annotations.file import write_annotations
from gsmap.datasets.annotations.record import MapInstance
from gsmap.datasets.errors import BrokenSampleError
from gsmap.datasets.transforms.corruptions import KINDS
from gsmap.datasets.transforms.images import LoadCameraImages
from gsmap.datasets.transforms.map_targets import FormatMapTargets

TOKEN = "token1"  # the second sample of its scene
CAMERAS = ("CAM_FRONT", "CAM_BACK")
SHAPE = (54, 96)
LOADED = {
    "img", "img_path", "to_float32", "raw_shapes", "img_shape", "ori_shape", "pad_shape",
    "num_views", "cam2img", "lidar2cam", "lidar2img", "img_aug_matrix",
}  # fmt: skip
SCALED = {"img", "img_shape", "pad_shape", "lidar2img", "img_aug_matrix"}


@dataclass(frozen=True)
class Case:
    """A transform with its settings, and its effect on the results of a pipeline.

    Attributes:
        settings: Arguments of the transform; ``FOLDER`` in a text is the folder of the files.
        adds: Keys that are not there before.
        changes: Keys with other values, or with further fields, afterwards.
        needs_truth: Whether the transform is refused for samples without ground truth.
        broken: Changed results with which the transform reports a broken sample.
        in_place: Keys with arrays that the transform of a library, from which ours inherits,
            changes in place.
        given: Entries of the results that replace those of `results_of`.
    """

    settings: dict[str, Any] = field(default_factory=dict)
    adds: set[str] = field(default_factory=set)
    changes: set[str] = field(default_factory=set)
    needs_truth: bool = False
    broken: dict[str, Any] = field(default_factory=dict)
    in_place: set[str] = field(default_factory=set)
    given: dict[str, Any] = field(default_factory=dict)


GONE = {"CAM_FRONT": {"img_path": "FOLDER/gone.jpg", "cam2img": np.eye(4), "lidar2cam": np.eye(4)}}
GONE_SWEEP = {"timestamp": 0.5, "lidar_points": {"lidar_path": "gone.bin", "lidar2sensor": pose(2)}}
POINTS = {"coord_type": "LIDAR", "load_dim": 5}
CASES: dict[str, dict[str, Case]] = {
    "LoadCameraImages": {
        "float32": Case(adds=LOADED, broken={"images": GONE}),
        "on the device": Case({"on_device": True}, adds={*LOADED, "image_steps"}),
    },
    "ScaleImages": {
        "by a factor": Case({"scale": 0.5}, adds={"scale_factor"}, changes={*SCALED, "raw_shapes"}),
        "to a size": Case({"size": (48, 30)}, changes={*SCALED, "raw_shapes"}),
    },
    "CropImages": {"10 rows": Case({"top": 10}, changes={*SCALED, "raw_shapes"})},
    "DistortImages": {"": Case(changes={"img"})},
    "CorruptImages": {
        kind: Case({"kind": kind, "severity": 3}, changes={"img", "lidar2cam", "lidar2img"})
        for kind in KINDS
    },
    "DelayCameras": {"": Case({"ann_file": "FOLDER/a.arrow", "severity": 1}, changes={"images"})},
    "DropCameras": {"": Case({"prob": 0.5}, changes={"img", "lidar2cam", "lidar2img"})},
    "FormatMapTargets": {"": Case(adds={"gt_instances_3d"}, needs_truth=True)},
    "MakeBEVMask": {"": Case(adds={"gt_seg"}, needs_truth=True)},
    "MakeInstanceMasks": {"": Case(changes={"gt_instances_3d"}, needs_truth=True)},
    "MakePVMask": {"": Case({"stride": 8}, adds={"gt_pv_seg"}, needs_truth=True)},
    "MakeDepthMap": {"": Case(adds={"gt_depth"})},
    "LoadLidarPoints": {
        "": Case(
            {**POINTS, "use_dim": 5},
            changes={"points"},
            broken={"lidar_points": {"lidar_path": "gone.bin"}},
        )
    },
    "LoadLidarSweeps": {
        "": Case(
            {"sweeps_num": 1, "use_dim": [0, 1, 2, 3, 4]},
            changes={"points"},
            broken={"lidar_sweeps": [GONE_SWEEP]},
            in_place={"points"},
        )
    },
    "PointsToFrame": {"": Case(changes={"points", "lidar2frame"}, given={"lidar2frame": pose(6)})},
    "PackMapInputs": {
        "": Case(
            adds={"inputs", "data_samples"},
            broken={"img": [np.full((*SHAPE, 3), np.nan, np.float32)] * len(CAMERAS)},
        )
    },
}
for _cases in cases_of_methods("TRANSFORM_CASES").values():
    CASES |= {name: {"": Case(**case)} for name, case in _cases.items()}
REGISTERED = [
    name
    for name, transform in TRANSFORMS.module_dict.items()
    if transform.__module__.startswith("gsmap.")
]
ALL = [
    pytest.param(name, variant, id=f"{name} {variant}".strip())
    for name in REGISTERED
    for variant in CASES.get(name, {"": None})
]
transforms = pytest.mark.parametrize(("name", "variant"), ALL)


def chosen(keep: Callable[[Case], Any]) -> pytest.MarkDecorator:
    """Mark for the transforms with a case that a function accepts."""
    names = [
        param
        for param in ALL
        if param.values[0] in CASES and keep(CASES[param.values[0]][param.values[1]])
    ]
    return pytest.mark.parametrize(("name", "variant"), names)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Annotations of two samples, and a LiDAR sweep."""
    made = tmp_path_factory.mktemp("contract")
    write_annotations(made / "a.arrow", META, [sample(0), sample(1)])
    points = np.random.default_rng(0).normal(scale=10.0, size=(200, 5))
    points.astype(np.float32).tofile(made / "sweep.bin")
    return made


def elements() -> list[MapInstance]:
    """Return a line of each of three classes, the second of them a ring."""
    ring = np.array([[-4.0, 0], [4, 0], [4, 8], [-4, 8], [-4, 0]])
    divider = np.array([[1.0, -20], [2, 5], [1, 20]])
    boundary = np.array([[-9.0, -25], [-9, 25]])
    return [MapInstance(0, divider), MapInstance(1, ring), MapInstance(2, boundary)]


def results_of(folder: Path, truth: list[MapInstance]) -> dict[str, Any]:
    """Return the results of a pipeline that has loaded images, points and targets.

    Args:
        folder: Folder of the files.
        truth: Map elements of the sample.
    """
    rng = np.random.default_rng(1)
    intrinsics = np.array([[80.0, 0, 48, 0], [0, 80, 27, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    images = {
        name: {
            "img_path": rng.integers(0, 255, (*SHAPE, 3), dtype=np.uint8),
            "cam2img": intrinsics,
            "lidar2cam": pose(number),
        }
        for number, name in enumerate(CAMERAS)
    }
    sweep = {"lidar_path": str(folder / "sweep.bin")}
    started = {
        "token": TOKEN,
        "images": images,
        "cam_names": list(CAMERAS),
        "map_instances": truth,
        "x_range": (-15.0, 15.0),
        "y_range": (-30.0, 30.0),
        "lidar2ego": pose(5),
        "lidar2ground": pose(5),
        "lidar2frame": np.eye(4),
        "timestamp": 1.0,
        "lidar_points": sweep,
        "lidar_sweeps": [{"timestamp": 0.5, "lidar_points": {**sweep, "lidar2sensor": pose(2)}}],
        "points": LiDARPoints(torch.randn(200, 5) * 10, points_dim=5),
    }
    return FormatMapTargets().transform(LoadCameraImages().transform(started))


class Asked:
    """A transform, and the results that it is given.

    Args:
        name: Registry name of the transform.
        variant: Name of its case.
        folder: Folder of the files.
    """

    def __init__(self, name: str, variant: str, folder: Path) -> None:
        assert name in CASES, f"{name} has no case in {__name__}"
        self.case = CASES[name][variant]
        self.folder = folder
        settings = {
            key: value.replace("FOLDER", str(folder)) if isinstance(value, str) else value
            for key, value in self.case.settings.items()
        }
        init_default_scope("mmdet3d")
        self.transform = TRANSFORMS.build({"type": name, **settings})

    def given(self, truth: list[MapInstance] | None = None) -> dict[str, Any]:
        """Return results without the keys that the transform adds.

        Args:
            truth: Map elements of the sample; None for those of `elements`.
        """
        torch.manual_seed(0)
        np.random.seed(0)  # noqa: NPY002 - of transforms
        results = results_of(self.folder, elements() if truth is None else truth) | self.case.given
        return {key: value for key, value in results.items() if key not in self.case.adds}

    def found(self, results: dict[str, Any], transform: Any = None) -> dict[str, Any]:
        """Return the results after the transform, which draws from one seed."""
        np.random.seed(1)  # noqa: NPY002 - of transforms
        return (transform or self.transform).transform(dict(results))


@pytest.fixture
def asked(name: str, variant: str, folder: Path) -> Asked:
    return Asked(name, variant, folder)


def plain(value: Any) -> Any:
    """Return a value of the results with arrays as their shape, type and bytes."""
    if isinstance(value, (np.ndarray, torch.Tensor)):
        array = np.asarray(value)
        return (array.shape, str(array.dtype), array.tobytes())
    if isinstance(value, BasePoints):
        return plain(value.tensor)
    if isinstance(value, (InstanceData, Det3DDataSample)):
        return plain({**value.metainfo, **dict(value.items())})
    if isinstance(value, MapInstance):
        return (value.label, plain(value.points))
    if isinstance(value, dict):
        return {key: plain(part) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(part) for part in value]
    return value


@transforms
def test_a_transform_adds_and_changes_its_keys_alone(asked):
    given = asked.given()
    before = {key: plain(value) for key, value in given.items()}
    found = asked.found(given)
    if "data_samples" in asked.case.adds:  # it packs the rest
        assert found.keys() == asked.case.adds
        return
    assert found.keys() == given.keys() | asked.case.adds
    changed = {key for key in given if plain(found[key]) != before[key]}
    assert changed <= asked.case.changes
    assert changed or asked.case.adds


@transforms
def test_arrays_and_lists_that_are_given_stay(asked):
    given = asked.given()
    before = copy.deepcopy(given)
    asked.found(given)
    for key in given.keys() - asked.case.in_place - {"gt_instances_3d"}:
        assert plain(given[key]) == plain(before[key]), key
    targets = before.get("gt_instances_3d", InstanceData())
    for name, value in targets.items():  # some transforms add further fields
        assert plain(given["gt_instances_3d"][name]) == plain(value), name


@transforms
def test_images_keep_their_type(asked):
    given = asked.given()
    found = asked.found(given)
    for image in found.get("img", []) if "img" in given else []:
        assert image.dtype == np.float32


@transforms
def test_a_seed_decides_and_pickling_changes_nothing(asked):
    given = asked.given()
    expected = plain(asked.found(copy.deepcopy(given)))
    assert plain(asked.found(copy.deepcopy(given))) == expected
    worker = pickle.loads(pickle.dumps(asked.transform))
    assert plain(asked.found(copy.deepcopy(given), worker)) == expected


@chosen(lambda case: case.needs_truth)
def test_a_sample_without_elements_has_empty_targets(asked):
    some = asked.found(asked.given())
    none = asked.found(asked.given(truth=[]))
    for key in asked.case.adds | asked.case.changes:
        if isinstance(none[key], InstanceData):
            assert len(none[key]) == 0
            assert none[key].keys() == some[key].keys()
            for name, value in some[key].items():
                assert none[key][name].dtype == value.dtype, name
                assert none[key][name].dim() == value.dim(), name
        else:
            assert none[key].shape == some[key].shape
            assert some[key].any()
            assert not none[key].any()


@chosen(lambda case: case.needs_truth)
def test_a_sample_without_ground_truth_is_named(asked, name):
    message = f"sample '{TOKEN}' has no ground truth: leave {name} out of this pipeline"
    with pytest.raises(ValueError, match=message):
        asked.found({**asked.given(), "map_instances": None})


@chosen(lambda case: case.broken)
def test_a_broken_sample_is_named(asked):
    with pytest.raises(BrokenSampleError, match=f"'{TOKEN}'"):
        asked.found({**asked.given(), **asked.case.broken})
