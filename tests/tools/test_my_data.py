"""One's own data from records to a picture, as docs/custom_data.md says it; one camera."""

import json
import re
import runpy
import sys
from pathlib import Path

import cv2
import pytest
from mmdet3d.registry import MODELS
from mmengine.config import Config
from mmengine.registry import init_default_scope

import gsmap.registered  # noqa: F401

REPO = Path(__file__).resolve().parents[2]
SMALL = """
_base_ = '{template}'
_still = dict(batch_size=1, num_workers=0, persistent_workers=False)
train_dataloader, val_dataloader, test_dataloader = _still, _still, _still
param_scheduler = []
train_cfg = dict(max_epochs=1)
visualizer = dict(width_px=400)
"""


def command(monkeypatch: pytest.MonkeyPatch, tool: str, *words: object) -> None:
    """Run a tool in this process."""
    monkeypatch.setattr(sys, "argv", [f"tools/{tool}.py", *map(str, words)])
    runpy.run_path(str(REPO / f"tools/{tool}.py"), run_name="__main__")


@pytest.fixture
def my_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder that the documented example makes."""
    monkeypatch.chdir(tmp_path)
    example = re.search(r"```python\n(.*?)```", (REPO / "docs/custom_data.md").read_text(), re.S)[1]
    exec(example, {})
    return tmp_path / "my_data"


def test_own_data_with_one_camera_train_test_and_infer(my_data, tmp_path, monkeypatch):
    template = (REPO / "configs/my_data.py").read_text().replace("'./", f"'{REPO}/configs/")
    edited = template.replace("_cameras = ['front', 'rear']", "_cameras = ['front']")
    assert edited != template
    (tmp_path / "my_city.py").write_text(edited)
    config, work = tmp_path / "small.py", tmp_path / "work"
    config.write_text(SMALL.format(template=tmp_path / "my_city.py"))
    command(monkeypatch, "create_data", "check", my_data / "train.arrow", "--data-root", my_data)
    command(monkeypatch, "train", config, "--data-root", my_data, "--work-dir", work)
    model = config, work / "epoch_1.pth"
    metrics, found = tmp_path / "metrics.json", tmp_path / "map.json"
    common = ["--work-dir", tmp_path / "test", "--metrics-out", metrics]
    command(monkeypatch, "test", *model, "--data-root", my_data, *common)
    assert json.loads(metrics.read_text())["chamfer/num_samples"] == 1
    seen = tmp_path / "seen"
    words = ["--model", *model, "--out", found, "--show-dir", seen, "--workers", 0]
    command(monkeypatch, "infer", my_data / "all.arrow", *words)
    tokens = [result["sample_token"] for result in json.loads(found.read_text())["results"]]
    assert tokens == ["drive7_000", "drive7_001"]
    pictures = sorted(seen.iterdir())
    assert [cv2.imread(str(path)).shape[1] for path in pictures] == [400, 400]
    (log,) = (path.read_text() for path in work.glob("*/*.log"))
    assert "cameras     1, their files 640 x 360" in log
    said = [line.partition("gsmap_r18_minicity.pth: ")[2] for line in log.splitlines()]
    assert {
        "embeddings of cameras: front as CAM_FRONT.",
        "queries of 50 x 25 BEV cells interpolated to 25 x 50.",
    } <= set(said)
    assert sum(line.startswith("frame was lidar, is ego: ") for line in said) == 1


def test_the_template_takes_the_documented_range(tmp_path):
    assert "multiples of 30 m, such as 120 x 60 m" in (REPO / "docs/custom_data.md").read_text()
    template = (REPO / "configs/my_data.py").read_text().replace("'./", f"'{REPO}/configs/")
    ranges = "x_range=[-60.0, 60.0], y_range=[-30.0, 30.0]"
    edited = template.replace("x_range=[-30.0, 30.0], y_range=[-15.0, 15.0]", ranges)
    assert edited != template
    (tmp_path / "my_city.py").write_text(edited)
    config = Config.fromfile(tmp_path / "my_city.py")
    init_default_scope("mmdet3d")
    grid = MODELS.build(config.model).bev_encoder.grid
    steps = config.train_dataloader.dataset.pipeline
    (mask,) = [step for step in steps if step.type == "MakeBEVMask"]
    assert mask["size"] == [grid.height, grid.width] == [50, 100]
