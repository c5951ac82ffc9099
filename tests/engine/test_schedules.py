"""Schedules that do not fit the length of a training are refused."""

import pytest
from mmengine.config import Config

from gsmap.engine.launch import check_config
from gsmap.engine.schedules import check_schedules


def test_a_cosine_schedule_of_another_length_is_refused():
    cfg = {"train_cfg": {"max_epochs": 110}, "param_scheduler": [{"by_epoch": True, "T_max": 24}]}
    with pytest.raises(ValueError, match="lasts 110 epochs but the cosine schedule 24"):
        check_config(Config(cfg))
    cfg["param_scheduler"][0]["T_max"] = 110
    check_config(Config(cfg))


@pytest.mark.parametrize(
    ("wrap", "name"),
    [
        (lambda scheduler: scheduler, "param_scheduler"),
        (lambda scheduler: [{"by_epoch": False}, scheduler], "param_scheduler.1"),
        (lambda scheduler: {"a": scheduler}, "param_scheduler.a"),
        (lambda scheduler: {"a": [], "b": [scheduler]}, "param_scheduler.b.0"),
    ],
)
def test_a_cosine_schedule_may_follow_a_warm_up(wrap, name):
    cfg = {"train_cfg": {"max_epochs": 24}}
    cfg["param_scheduler"] = wrap({"begin": 4, "T_max": 20})
    check_config(Config(cfg))
    cfg["param_scheduler"] = wrap({"begin": 4, "T_max": 24})
    with pytest.raises(ValueError, match=rf"schedule 24 and begins after 4: .* and {name}\.T_max"):
        check_config(Config(cfg))


@pytest.mark.parametrize(
    ("scheduler", "epochs", "reason"),
    [
        ({"milestones": [100, 120]}, 121, None),
        (
            {"milestones": (100, 120)},
            120,
            r"comes after 120: set param_scheduler\.0\.milestones to",
        ),
        ({"milestones": [100, 120]}, 110, "lasts 110 epochs but the last milestone .* below 110,"),
        ({"milestones": [20, 30], "begin": 5}, 36, None),
        ({"milestones": [20, 30], "begin": 5}, 35, "comes after 35: .* to numbers below 30, or"),
        ({"milestones": [900], "by_epoch": False}, 10, None),  # iterations
        ({"milestones": []}, 1, None),
    ],
)
def test_milestones_that_a_training_does_not_reach_are_refused(scheduler, epochs, reason):
    cfg = Config({"train_cfg": {"max_epochs": epochs}, "param_scheduler": [scheduler]})
    check_config(cfg, for_training=False)  # a test has no schedule
    if reason is None:
        check_config(cfg)
        return
    with pytest.raises(ValueError, match=reason):
        check_config(cfg)


@pytest.mark.parametrize(
    ("schedulers", "reason"),
    [
        # cyclic schedules of mmdet3d, of two halves
        ([{"T_max": 8, "end": 8}, {"T_max": 12, "begin": 8, "end": 20}], None),
        ([{"T_max": 8, "end": 8}, {"T_max": 12, "begin": 8}], None),
        ([{"T_max": 8, "end": 9}], "the cosine schedule 8 and ends after 9"),
        ([{"T_max": 20, "end": 40}], r"ends after 40: set param_scheduler\.0\.begin and \.end to"),
        ([{"type": "PolyLR", "end": 24}], "ends after 24"),
        ([{"type": "PolyLR", "begin": 20}], "begins after 20"),
        ([{"type": "LinearLR", "end": 24}], None),
        ([{"milestones": [8], "end": 8}], "comes after 8"),
        ([{"type": "mmengine.LinearLR", "end": 24}], None),
        ([{"type": "LinearMomentum", "end": 24}], None),
        ([{"milestones": [8], "end": 1_000_000_000}], None),  # mmengine's default
        ([{"milestones": [8], "end": float("inf")}], None),
        ([{"type": "OneCycleLR", "total_steps": 20}], None),
        (
            [{"type": "OneCycleLR", "total_steps": 24}],
            r"set both .* and param_scheduler\.0\.total_steps",
        ),
        ([{"type": "CosineRestartLR", "periods": [8, 12]}], None),
        ([{"type": "CosineRestartLR", "periods": [12, 12]}], r"schedule 24: .*\.0\.periods"),
        ([{"milestones": [8], "end": None}], "must be numbers of epochs, got 0 and None"),
        ([{"milestones": [8], "begin": "2"}], "must be numbers of epochs, got '2' and 20"),
    ],
)
def test_schedules_may_have_an_end_of_their_own(schedulers, reason):
    cfg = Config({"train_cfg": {"max_epochs": 20}, "param_scheduler": schedulers})
    if reason is None:
        check_schedules(cfg)
        return
    with pytest.raises(ValueError, match=reason):
        check_schedules(cfg)


@pytest.mark.parametrize(
    ("scheduler", "reason"),
    [
        ({"T_max": 1000, "by_epoch": False}, None),
        ({"T_max": 900, "begin": 100, "by_epoch": False}, None),
        ({"T_max": 1000, "begin": 100, "by_epoch": False}, "lasts 1000 iterations but the cosine"),
        ({"T_max": 2000, "by_epoch": False}, "lasts 1000 iterations but the cosine schedule 2000"),
        ({"milestones": [1000], "by_epoch": False}, "comes after 1000: .* below 1000"),
        ({"type": "LinearLR", "end": 2000, "by_epoch": False}, None),
        ({"type": "PolyLR", "end": 2000, "by_epoch": False}, "ends after 2000"),
    ],
)
@pytest.mark.parametrize("train_cfg", [{"max_epochs": 10}, {"max_iters": 1000}])
def test_schedules_over_iterations_fit_the_training(scheduler, reason, train_cfg):
    cfg = Config({"train_cfg": train_cfg, "param_scheduler": scheduler})
    if "max_epochs" in train_cfg:
        check_schedules(cfg)  # the number of iterations is not yet known
    if reason is None:
        check_schedules(cfg, iterations=1000)
        return
    with pytest.raises(ValueError, match=reason):
        check_schedules(cfg, iterations=1000)
    if "max_iters" in train_cfg:
        with pytest.raises(ValueError, match=reason):
            check_schedules(cfg)


def test_a_training_by_iterations_needs_schedules_by_iterations():
    cfg = Config({"train_cfg": {"max_iters": 1000}, "param_scheduler": [{"milestones": [8]}]})
    with pytest.raises(ValueError, match=r"never change a value: set param_scheduler\.0\.by_epoch"):
        check_schedules(cfg)
    cfg.param_scheduler[0].convert_to_iter_based = True
    check_schedules(cfg)
    cfg.param_scheduler = [{"type": "ReduceOnPlateauLR"}]  # changes values after a validation
    check_schedules(cfg)
