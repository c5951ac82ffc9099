"""Every Python block of every page runs, in the order of its page.

A reader puts own files and values in the place of some words: ``CONFIG``, ``ROOT/...``, a variable
that the page describes. ``STAND_INS`` and ``GIVEN`` say what stands for them; a block that needs
anything else fails. A block that only assigns is a config: its types are looked up.
"""

import ast
import re
import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import mmengine._strategy  # noqa: F401 - and strategies
import numpy as np
import pytest
import shapely
from mmdet3d import registry as of_mmdet3d
from mmengine import registry
from mmengine.config import Config
from model_cases import IMAGE_SHAPE, NUM_CAMS
from report_case import write_case

import gsmap.registered  # noqa: F401 - the configs name its classes
from gsmap.datasets.transforms.images import LoadCameraImages, ScaleImages

REPO = Path(__file__).resolve().parents[1]
PAGES = [REPO / "README.md"]
PAGES += sorted([*(REPO / "docs").rglob("*.md"), *REPO.glob("*/*/README.md")])
PAGES += sorted((REPO / "results").glob("*.md"))
BLOCK = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
WITH_BLOCKS = [page for page in dict.fromkeys(PAGES) if BLOCK.search(page.read_text())]
BASE = str(REPO / "configs/maptr/maptr_r18_minicity.py")  # what a config reads as _base_
OWN_TESTS = {
    "docs/library.md": "test_docs_library.py",
    "docs/add_a_method.md": "test_docs_method.py",
}
STAND_INS = {
    "'CONFIG', 'CHECKPOINT', device='cuda'": "'gsmap_r18_minicity', device='cpu'",
    "open_input('INPUT')": "open_input('val.arrow')",
    "num_workers=2": "num_workers=0",  # no fork out of a test
    "_base_ = '../maptr/maptr_r18_minicity.py'": f"_base_ = Config.fromfile({BASE!r})",
}
REGISTRIES = [
    each
    for each in (*vars(of_mmdet3d).values(), *vars(registry).values())
    if isinstance(each, registry.Registry)
]
MADE = {
    "docs/inference.md": "sample.png",
    "docs/visualization.md": "report.html",
    "docs/deployment.md": "results.json",
}


def line(**more: Any) -> SimpleNamespace:
    return SimpleNamespace(lines=[np.array([[0.0, -20], [0, 20]])], labels=[0], **more)


def samples(folder: Path, minicity: Path) -> dict[str, Any]:
    """What a reader of docs/visualization.md has: a data set, one of its samples, results."""
    from gsmap import MapInferencer

    path, results = write_case(folder)
    shutil.copy(path, folder / "val.arrow")
    shutil.copy(results["good"], folder / "gsmap.json")
    inferencer = MapInferencer("gsmap_r18_minicity", device="cpu")
    dataset = inferencer.dataset(minicity)
    return {"dataset": dataset, "data_sample": dataset[0]["data_samples"]}


def deployment(folder: Path, minicity: Path) -> dict[str, Any]:
    """What a reader of docs/deployment.md has beside exported files: an image and a drive."""
    cv2.imwrite(str(folder / "image.jpg"), np.full((225, 400, 3), 90, np.uint8))
    cv2.imwrite(str(folder / "small.jpg"), np.full((180, 200, 3), 90, np.uint8))
    intrinsics = np.array([[320.0, 0, 200], [0, 320, 112], [0, 0, 1]])
    cameras = [("image.jpg", intrinsics, np.eye(4))] * NUM_CAMS
    cameras[-1] = ("small.jpg", intrinsics, np.eye(4))
    images = [np.zeros((*IMAGE_SHAPE, 3), np.uint8)] * NUM_CAMS
    meta = {"scene": "a", "lidar2global": np.eye(4), "can_bus": np.zeros(18)}
    meta["lidar2img"] = np.stack([np.eye(4)] * NUM_CAMS)
    drive = [(images, {**meta, "timestamp_ns": time}) for time in (0, 500_000_000)]
    return {"my_cameras": cameras, "my_can_bus": np.zeros(18), "my_drive": drive}


def town(folder: Path, minicity: Path) -> dict[str, Any]:
    """What a reader of the renderer's page has: a street of 100 m and a camera on it."""
    left, right = np.array([[0.0, 4], [100, 4]]), np.array([[0.0, -4], [100, -4]])
    ahead = np.eye(4)
    ahead[:3, :3] = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
    ahead[:3, 3] = ahead[:3, :3] @ [-20.0, 0, -1.5]
    across = np.array([[40.0, -4], [40, 4]])
    return {
        "drivable_polygon": shapely.box(0, -5, 100, 5),
        "left_boundary": left,
        "lane_boundary": (left + right) / 2,
        "crossing_edge_1": across,
        "crossing_edge_2": across + np.array([3, 0]),
        "heights": np.zeros((200, 400)),
        "intrinsics": np.array([[50.0, 0, 32], [0, 50, 18], [0, 0, 1]]),
        "cam_from_world": ahead,
        **{"x0": -20, "y0": -30, "xmin": 0, "ymin": -20, "xmax": 90, "ymax": 20},
        **{"seed": 0, "width": 64, "height": 36},
    }


def towns_in(name: str) -> Callable:
    """Give the annotation file of generated towns a name."""

    def put(folder: Path, minicity: Path) -> dict[str, Any]:
        (folder / name).parent.mkdir(parents=True)
        shutil.copy(minicity, folder / name)
        (folder / "work_dirs").mkdir()
        (folder / "models").symlink_to(REPO / "models")
        return {}

    return put


def towns(folder: Path, minicity: Path) -> dict[str, Any]:
    folder.rmdir()
    shutil.copytree(minicity.parent, folder)
    (folder / minicity.name).rename(folder / "val.arrow")
    return {}


GIVEN: Mapping[str, Callable[[Path, Path], dict[str, Any]]] = {
    "docs/data.md": towns_in("data/minicity/gsmap_minicity_val.arrow"),
    "results/methods.md": towns_in("ROOT/gsmap_minicity_train.arrow"),
    "docs/evaluation.md": lambda *_: {"frames": [(line(scores=[0.9]), line())]},
    "docs/inference.md": towns,
    "docs/visualization.md": samples,
    "docs/deployment.md": deployment,
    "projects/MiniCity/README.md": town,
}
# Exported files of a page, and the fixtures that make them. How a file is read does not depend on
# its size; the file without memory is a GSMap's, whose elements have scales.
FILES = {
    "docs/deployment.md": {"model.onnx": "small_onnx", "stream.onnx": "stream_onnx"},
    "docs/tutorial.md": {"work_dirs/tutorial/model.onnx": "small_onnx"},
}


def types_of(value: Any) -> Iterator[str]:
    """Yield every ``type`` in a config."""
    if isinstance(value, dict):
        yield from [value["type"]] if isinstance(value.get("type"), str) else []
        value = list(value.values())
    if isinstance(value, list | tuple):
        for each in value:
            yield from types_of(each)


def check_types(values: Mapping[str, Any]) -> None:
    """Raise an error if a config names a type that no registry has."""
    for name in types_of(list(values.values())):
        known = any(name in each.module_dict for each in REGISTRIES)
        assert known or "." in name, f"no registry has a type {name!r}"


@pytest.mark.parametrize("page", WITH_BLOCKS, ids=lambda page: str(page.relative_to(REPO)))
def test_the_blocks_of_a_page_run(page: Path, tmp_path, monkeypatch, request):
    name = str(page.relative_to(REPO))
    if name in OWN_TESTS:
        assert (REPO / "tests" / OWN_TESTS[name]).exists()
        return
    scope: dict[str, Any] = {"__name__": "page", "Config": Config}
    if name in GIVEN:
        minicity = request.getfixturevalue("minicity_annotations")["val"]
        scope |= GIVEN[name](tmp_path, minicity)
    for place, fixture in FILES.get(name, {}).items():
        (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(request.getfixturevalue(fixture), tmp_path / place)
    monkeypatch.chdir(tmp_path)
    for block in BLOCK.findall(page.read_text()):
        for words, stand_in in STAND_INS.items():
            block = block.replace(words, stand_in)
        statements = ast.parse(block).body
        before = dict(scope)
        exec(block, scope)
        if all(isinstance(each, ast.Assign) for each in statements):
            new = scope.keys() - before.keys() - {"__builtins__"}
            check_types({key: scope[key] for key in new})
    assert (tmp_path / MADE.get(name, "")).exists()


def test_the_images_of_deployment_are_those_of_the_pipeline(tmp_path, monkeypatch):
    """Cameras of two sizes: the smaller images are padded before all are scaled."""
    given = deployment(tmp_path, tmp_path)
    cameras = given["my_cameras"]
    monkeypatch.chdir(tmp_path)
    records = {}
    for number, (path, intrinsics, cam_from_frame) in enumerate(cameras):
        cam2img = np.eye(4)
        cam2img[:3, :3] = intrinsics
        records[number] = {"img_path": path, "cam2img": cam2img, "lidar2cam": cam_from_frame}
    expected = LoadCameraImages().transform({"token": "t", "images": records})
    expected = ScaleImages(scale=0.25).transform(expected)
    block = BLOCK.findall((REPO / "docs/deployment.md").read_text())[0]
    recipe = block[block.index("files = ") : block.index("elements = ")]
    scope = {"cv2": cv2, "np": np, "my_cameras": cameras}
    scope["model"] = SimpleNamespace(image_size=expected["img_shape"])
    exec(recipe, scope)
    np.testing.assert_allclose(scope["images"], expected["img"], atol=1)  # rounded to uint8
    np.testing.assert_allclose(scope["lidar2img"], expected["lidar2img"])


def test_a_stale_type_is_found():
    with pytest.raises(AssertionError, match="MapVizualizer"):
        check_types({"visualizer": {"vis_backends": [{"type": "MapVizualizer"}]}})
