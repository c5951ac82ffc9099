"""Settings that the transforms of targets take from the head."""

import pytest
from mmengine.config import Config

from gsmap.engine.launch import check_config, read_config

HDMAPNET = "configs/hdmapnet/hdmapnet_r18_minicity.py"
# config, override of the head, and what the transform of its targets has then
CASES = [
    ("maptr/maptr_r18_minicity", {"num_points": 12}, {"num_points": 12}),
    (
        "pivotnet/pivotnet_r18_minicity",
        {"queries": [[9, 4], [9, 6], [9, 8]], "mask_pixel_m": 0.9375},
        {"num_points": [4, 6, 8], "pixel_m": 0.9375},
    ),
    (
        "bemapnet/bemapnet_r18_minicity",
        {"pieces": [2, 2, 2], "degrees": [1, 2, 3]},
        {"pieces": [2, 2, 2], "degrees": [1, 2, 3], "pixel_m": 0.46875},
    ),
    (
        "hdmapnet/hdmapnet_r18_minicity",
        {"num_directions": 72, "pixel_m": 0.6},
        {"num_directions": 72, "pixel_m": 0.6},
    ),
    ("vectormapnet/vectormapnet_r18_minicity", {"canvas": {"margin_m": 3.0}}, {"margin_m": 3.0}),
]


def targets_of(cfg: Config) -> dict:
    """Return the step of the training pipeline that makes the targets."""
    steps = cfg.train_dataloader.dataset.pipeline
    (step,) = [step for step in steps if step.type.startswith(("Format", "MakeLine"))]
    return step


@pytest.mark.parametrize(("name", "changes", "wanted"), CASES, ids=[case[0] for case in CASES])
def test_an_override_of_the_head_reaches_the_transform_of_its_targets(name, changes, wanted):
    options = {f"model.map_head.{key}": value for key, value in changes.items()}
    cfg = read_config(f"configs/{name}.py", options)
    check_config(cfg)
    step = targets_of(cfg)
    for key, value in wanted.items():
        found = list(step[key]) if isinstance(value, list) else step[key]
        assert found == value, key


def test_a_transform_that_names_another_value_is_refused_in_training_alone():
    cfg = read_config(HDMAPNET)
    targets_of(cfg).num_directions = 72
    again = read_config(cfg)  # as inference reads it
    assert targets_of(again).num_directions == 72
    with pytest.raises(ValueError, match=r"num_directions of MakeLineMaps is 72.* makes it 36"):
        check_config(again)
    again.model.map_head.num_directions = 72
    check_config(again)


def test_wrapped_data_sets_and_steps_take_the_settings_too():
    cfg = read_config(HDMAPNET)
    plain = cfg.train_dataloader.dataset.to_dict()
    inner = {"type": "RandomApply", "transforms": [{"type": "MakeLineMaps"}]}
    wrapped = {"type": "RepeatDataset", "times": 2, "dataset": {**plain, "pipeline": [inner]}}
    cfg.train_dataloader.dataset = wrapped
    cfg = read_config(cfg)
    (step,) = cfg.train_dataloader.dataset.dataset.pipeline[0].transforms
    assert step.pixel_m == 0.3


@pytest.mark.parametrize("queries", [5, [5, 5, 5], None])
def test_settings_that_the_head_refuses_are_left_to_it(queries):
    cfg = read_config("configs/pivotnet/pivotnet_r18_minicity.py")
    cfg.model.map_head.queries = queries
    read_config(cfg)
