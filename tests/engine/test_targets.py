"""Settings that the transforms of targets take from the head."""

import pytest
from method_cases import cases_of_methods
from mmdet3d.registry import TRANSFORMS
from mmengine.config import Config

from gsmap.engine.launch import check_config, read_config

MAPTR = "configs/maptr/maptr_r18_minicity.py"
# override of the head, and the settings that the transform of its targets has then
CASES = {"maptr": ({"num_points": 12}, {"num_points": 12}), **cases_of_methods("TARGETS")}


def targets_of(cfg: Config) -> dict:
    """Return the step of the training pipeline that makes the targets."""
    steps = cfg.train_dataloader.dataset.pipeline
    (step,) = [step for step in steps if step.type.startswith(("Format", "MakeLine"))]
    return step


@pytest.mark.parametrize("method", CASES)
def test_an_override_of_the_head_reaches_the_transform_of_its_targets(method):
    changes, wanted = CASES[method]
    options = {f"model.map_head.{key}": value for key, value in changes.items()}
    cfg = read_config(f"configs/{method}/{method}_r18_minicity.py", options)
    check_config(cfg)
    step = targets_of(cfg)
    for key, value in wanted.items():
        found = list(step[key]) if isinstance(value, list) else step[key]
        assert found == value, key


def test_a_transform_that_names_another_value_is_refused_in_training_alone():
    cfg = read_config(MAPTR)
    points = cfg.model.map_head.num_points
    targets_of(cfg).num_points = 12
    again = read_config(cfg)  # as inference reads it
    assert targets_of(again).num_points == 12
    message = rf"num_points of FormatMapTargets is 12.* require {points}"
    with pytest.raises(ValueError, match=message):
        check_config(again)
    again.model.map_head.num_points = 12
    check_config(again)


def test_wrapped_data_sets_and_steps_take_the_settings_too():
    cfg = read_config(MAPTR)
    plain = cfg.train_dataloader.dataset.to_dict()
    inner = {"type": "RandomApply", "transforms": [{"type": "FormatMapTargets"}]}
    wrapped = {"type": "RepeatDataset", "times": 2, "dataset": {**plain, "pipeline": [inner]}}
    cfg.train_dataloader.dataset = wrapped
    cfg = read_config(cfg)
    (step,) = cfg.train_dataloader.dataset.dataset.pipeline[0].transforms
    assert step.num_points == cfg.model.map_head.num_points


def test_the_direction_of_travel_of_the_grid_reaches_masks_and_maps():
    """Masks of a square map would be turned by 90 degrees, in silence."""
    checked = 0
    for method in CASES:
        cfg = read_config(f"configs/{method}/{method}_r18_minicity.py", {"model.grid.forward": "x"})
        step = targets_of(cfg)
        if not hasattr(TRANSFORMS.get(step.type), "forward"):
            continue
        assert step.forward == "x"
        step.forward = "y"
        with pytest.raises(ValueError, match=r"forward of .* is y.* require x"):
            check_config(cfg)
        checked += 1
    assert checked >= 3
