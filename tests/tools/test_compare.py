"""Every row of the papers' tables: its config loads, its overrides change it, its model builds."""

import argparse
from functools import cache
from pathlib import Path

import pytest
import torch
from method_cases import cases_of_methods
from mmdet3d.registry import MODELS, TRANSFORMS
from mmengine.config import Config
from processes import run_tool
from unset_weights import unset_weights

from gsmap.engine.arguments import add_config_options
from gsmap.engine.launch import check_config, read_config
from gsmap.evaluation.core.metric import metric_class
from gsmap.methods import METHODS
from tools.compare import published_figures, read_tables, training_command

REPO = Path(__file__).resolve().parents[2]
ROWS = [
    pytest.param(row, id=f"{table['table']}: {row['row']}")
    for table in read_tables()
    for row in table["rows"]
    if row["config"]
]
TARGETS = {"FormatBezierTargets", "FormatMapTargets", "FormatPivotTargets"}
METRICS = {
    column.partition("/")[0]
    for table in read_tables()
    for column in table["columns"]
    if "/" in column
}
TARGET_CHECKS = cases_of_methods("check_targets")
EXTENDED = "configs/maptr/maptr_r50_extended_24e.py"


@cache
def base(config: str) -> Config:
    return read_config(REPO / config)


def parsed(options: list[str]) -> dict:
    """Parse overrides as the tools do."""
    parser = argparse.ArgumentParser()
    add_config_options(parser)
    return parser.parse_args(["--cfg-options", *options]).cfg_options


BUILT: dict[str, torch.nn.Module] = {}  # by settings, which several rows have


def build(cfg: Config) -> torch.nn.Module:
    """Return the model of a config without initial values of its weights; no test changes it."""
    for part in ("img_backbone", "img_neck"):
        if cfg.model.get(part):
            cfg.model[part].init_cfg = None
    settings = repr(cfg.model.to_dict())
    if settings not in BUILT:
        with unset_weights():
            BUILT[settings] = MODELS.build(cfg.model)
    return BUILT[settings]


@pytest.mark.parametrize("row", ROWS)
def test_a_rows_config_is_changed_by_its_overrides_and_builds(row):
    options = parsed(row["options"]) if row["options"] else {}
    before = base(row["config"])
    cfg = read_config(before, options)
    for name, value in options.items():
        assert before.get(name, "unset") != value, f"{name} is {value} anyway"
    check_config(cfg)
    model = build(cfg)
    steps = [s for s in cfg.train_dataloader.dataset.pipeline if s.type in TARGETS]
    head = model.map_head
    method = Path(row["config"]).parent.name
    if method in TARGET_CHECKS:
        TARGET_CHECKS[method](head, steps)
    else:
        assert [TRANSFORMS.build(step).num_points for step in steps] == [head.num_points]


def test_every_figure_has_a_metric_and_no_row_stands_twice():
    for table in read_tables():
        names = [row["row"] for row in table["rows"]]
        assert len(set(names)) == len(names), table["table"]
        for row in table["rows"]:
            assert row["config"] or row["note"]
            assert row["paper"] is None or len(row["paper"]) == len(table["columns"])
    for name in METRICS:  # a variant, such as NAME_hard, is reported by the metric NAME
        assert metric_class(name.partition("_")[0])
    columns = {column for table in read_tables() for column in table["columns"]}
    assert columns <= {
        f"{metric}/{name}"
        for metric in METRICS
        for name in ("mAP", *(f"{c}/AP" for c in base(EXTENDED).classes))
    } | {"fps", "params_M", "memory_MB", "seconds_per_step"}


def test_each_method_adds_its_rows_to_a_table_of_several_methods():
    (table,) = read_tables("Splits by place, Argoverse 2")
    splits = list(table["variants"])
    assert len(splits) == 2
    for split in splits:
        configs = [row["config"] for row in table["rows"] if row["row"].endswith(f", {split}")]
        assert configs[:2] == [
            "projects/GSMap/configs/gsmap_maptr_r50_av2_6e.py",
            "configs/maptr/maptr_r50_av2_6e.py",
        ]
    assert table["rows"][-1]["options"] == table["variants"][splits[-1]]


def test_shared_tables_exist():
    names = {table["table"] for table in read_tables() if "variants" in table}
    assert names
    for method in METHODS:
        assert method.paper().get("shared_tables", {}).keys() <= names, method.name


def test_the_means_of_the_papers_are_means():
    """A misread digit shows: the classes' mean is the printed one, but for rounding.

    One table itself is off, in a row without a config: 31.0 for 16.3, 29.6 and 46.7.
    """
    for table in read_tables():
        for row in table["rows"]:
            if not row["paper"] or not row["config"]:
                continue
            values = dict(zip(table["columns"], row["paper"], strict=True))
            for metric in METRICS:
                of_metric = {k: v for k, v in values.items() if k.startswith(f"{metric}/")}
                classes = [v for k, v in of_metric.items() if "/AP" in k and v is not None]
                mean = values.get(f"{metric}/mAP")
                if mean is not None and len(classes) > 1:
                    assert sum(classes) / len(classes) == pytest.approx(mean, abs=0.11), row


def test_commands_and_figures_of_a_row_by_hand():
    (table,) = read_tables("GSMap Table 5*")
    row = table["rows"][0]
    assert training_command(row) == (
        "python tools/train.py projects/GSMap/configs/gsmap_maptr_r50_24e.py "
        "--cfg-options model.map_head.loss_raster.loss_weight=5.0"
    )
    assert published_figures(table, row) == "chamfer/mAP 49.1, raster/mAP 32.3"
    (table,) = read_tables("GSMap Table 7*")
    assert published_figures(table, table["rows"][1]).endswith("mAP 33.9, memory_MB 11615")


def test_the_command_lists_and_names_what_there_is():
    words = "tools/compare.py", "--list", "--tables"
    run = run_tool(*words, "GSMap Table 5*")
    assert ": chamfer/mAP 49.1, raster/mAP 32.3" in run.stdout
    assert "model.map_head.loss_raster.loss_weight=5.0" in run.stdout
    bad = run_tool(*words, "X")
    assert bad.returncode == 2
    assert "no table is named 'X': compare.py --list names all" in bad.stderr
