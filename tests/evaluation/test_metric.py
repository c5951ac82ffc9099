"""A metric of one's own: one file, found by its name through the command, the config and shards."""

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from golden_data import CLASSES
from processes import run_python, search_path
from test_files import annotated, command, results_of

from gsmap.evaluation import MapEvaluator, MapMetric
from gsmap.evaluation.core import metric as metric_module
from gsmap.evaluation.core.metric import (
    Metric,
    MetricSettings,
    SampleValues,
    ValueTable,
    arrays_of,
    matches_of,
    metric_class,
    metric_files,
    register_metric,
)
from gsmap.evaluation.core.results_json import write_results
from gsmap.structures.elements import MapElements
from gsmap.structures.grid import BEVGrid
from tools.merge import main as merge

PAGE = Path(__file__).resolve().parents[2] / "docs/evaluation.md"
(OWN_METRIC,) = re.findall(r"```python\n(.*?@register_metric.*?)```", PAGE.read_text(), re.DOTALL)


@pytest.fixture
def own_module(tmp_path, monkeypatch):
    """The metric as a module that can be imported, and that no other test knows."""
    (tmp_path / "own_metric.py").write_text(OWN_METRIC)
    monkeypatch.syspath_prepend(tmp_path)
    yield "own_metric"
    sys.modules.pop("own_metric", None)
    metric_module._REGISTERED.pop("lengths", None)


@pytest.fixture
def scored(tmp_path) -> list[str]:
    truth = annotated(tmp_path / "val.arrow", 8)
    write_results(tmp_path / "results.json", results_of(8))
    return [str(tmp_path / "results.json"), str(truth)]


def figures_in(path: Path) -> dict[str, float]:
    found = json.loads(path.read_text())
    return {key: value for key, value in found.items() if key.startswith("lengths/")}


WANTED = {"lengths/divider": 1.0, "lengths/ped_crossing": 0.5, "lengths/boundary": 0.0}
"""The line is found everywhere, the ring in every second sample."""


def test_the_command_finds_a_metric_of_ones_own_by_its_name(own_module, scored, tmp_path, capsys):
    out = tmp_path / "metrics.json"
    names = ["--eval", "chamfer", "lengths", "--custom-imports", own_module]
    assert command()([*scored, *names, "--out", str(out)]).startswith("8 samples")
    assert figures_in(out) == pytest.approx(WANTED)
    assert json.loads(out.read_text())["chamfer/divider/AP"] == 1
    assert "lengths/ped_crossing" in capsys.readouterr().out
    alone = [*scored, "--eval", "lengths", "--custom-imports", own_module, "--out", str(out)]
    assert command()(alone).startswith("8 samples")
    assert figures_in(out) == pytest.approx(WANTED)


def test_it_leaves_out_elements_of_other_classes(own_module, scored, tmp_path):
    out = tmp_path / "metrics.json"
    names = ["--eval", "lengths", "--custom-imports", own_module, "--classes", *CLASSES[1:]]
    command()([*scored, *names, "--out", str(out)])
    assert figures_in(out) == pytest.approx({name: WANTED[name] for name in list(WANTED)[1:]})


def test_its_workers_find_it_too(own_module, scored, tmp_path):
    out = tmp_path / "metrics.json"
    names = ["--eval", "lengths", "--custom-imports", own_module, "--workers", "2"]
    words = ["tools/evaluate.py", *scored, *names, "--out", out]
    run_python(*words, check=True, env=search_path(tmp_path))
    assert figures_in(out) == pytest.approx(WANTED)


def test_its_figures_of_shards_are_those_of_the_whole(own_module, scored, tmp_path):
    parts = tmp_path / "parts.json"
    names = ["--eval", "raster", "lengths", "pld", "topology", "--custom-imports", own_module]
    for part in ("0/2", "1/2"):
        command()([*scored, *names, "--out", str(parts), "--shard", part])
    merge([str(parts)])
    whole = tmp_path / "whole.json"
    command()([*scored, *names, "--out", str(whole)])
    assert parts.read_bytes() == whole.read_bytes()
    assert figures_in(whole) == pytest.approx(WANTED)


def test_shards_of_metrics_of_all_kinds_are_joined_to_the_same_bytes(scored, tmp_path):
    names = ["--eval", "pld", "chamfer", "topology", "raster", "chamfer_hard", "vectormapnet"]
    for part in ("0/2", "1/2"):
        command()([*scored, *names, "--out", str(tmp_path / "parts.json"), "--shard", part])
    merge([str(tmp_path / "parts.json")])
    command()([*scored, *names, "--out", str(tmp_path / "whole.json")])
    assert (tmp_path / "parts.json").read_bytes() == (tmp_path / "whole.json").read_bytes()


def test_a_single_number_of_a_sample_is_joined_from_shards(own_module, scored, tmp_path):
    """The metres of a sample as one number in place of an array for each class."""
    text = OWN_METRIC.replace("{'metres': metres}", "{'metres': metres[0].sum()}")
    text = text.replace(
        "found, true = np.sum(table.column('metres'), axis=0)",
        "found = true = np.full(len(self.classes), np.sum(table.column('metres')))",
    )
    assert text.count("metres[0].sum()") == text.count("np.full") == 1
    (tmp_path / "own_metric.py").write_text(text)
    names = ["--eval", "lengths", "--custom-imports", own_module]
    for part in ("0/2", "1/2"):
        command()([*scored, *names, "--out", str(tmp_path / "parts.json"), "--shard", part])
    merge([str(tmp_path / "parts.json")])
    assert figures_in(tmp_path / "parts.json") == {f"lengths/{name}": 1.0 for name in CLASSES}


def test_a_config_names_it_as_well(own_module):
    with pytest.raises(ValueError, match=r"there is no metric .*'lengths'"):
        MapMetric(eval=["lengths"])
    __import__(own_module)  # as `custom_imports` does
    metric = MapMetric(eval=["chamfer", "lengths"])
    metric.dataset_meta = {"classes": CLASSES}
    assert [own.name for own in metric.evaluator.metrics] == ["chamfer", "lengths"]


def test_each_file_of_metrics_holds_those_that_have_its_name():
    known = metric_module._REGISTERED
    files = metric_files()
    assert {"chamfer", "raster", "pld", "topology"} <= files.keys()
    assert any(".models." in module for module in files.values())
    for stem, module in files.items():
        assert metric_class(stem).__module__ == module
    for name, kind in known.items():
        if kind.__module__.startswith("gsmap."):
            stem = next(s for s, module in files.items() if module == kind.__module__)
            assert name == stem or name.startswith(f"{stem}_")


def test_two_metrics_of_one_name_are_refused(own_module):
    __import__(own_module)

    class Other(Metric):
        name = "lengths"

    with pytest.raises(ValueError, match="own_metric has a metric 'lengths': choose another"):
        register_metric(Other)


def test_a_table_of_values_is_in_the_order_of_tokens_and_counts_a_token_once():
    table = ValueTable()
    for token, value in (("b", 2.0), ("a", 1.0), ("b", 3.0)):
        table.add(SampleValues(token, {"x": [value]}))
    assert table.tokens == ["a", "b"]
    assert [list(x) for x in table.column("x")] == [[1.0], [2.0]]
    assert len(table) == 2


def test_only_some_names_of_samples_are_refused():
    line = MapElements.from_polylines([[[0.0, -20.0], [0.0, 20.0]]], [0], [0.9])
    evaluator = MapEvaluator.from_names(["chamfer"], MetricSettings(CLASSES))
    for tokens in ((None, "000000002"), ("a", None)):
        evaluator.update(line, line, token=tokens[0])
        with pytest.raises(ValueError, match="a token for every sample, or for none"):
            evaluator.update(line, line, token=tokens[1])
        evaluator.reset()
    evaluator.update(line, line)
    evaluator.update(line, line)
    assert evaluator.compute()["chamfer/num_samples"] == 2


@pytest.mark.parametrize("name", ["chamfer", "raster", "pld", "topology", "heights", "bemapnet"])
def test_matches_made_again_are_the_same_and_of_other_shapes_refused(name):
    settings = MetricSettings(CLASSES, grid=BEVGrid((-15.0, 15.0), (-30.0, 30.0)))
    evaluator = MapEvaluator.from_names([name], settings)
    line = [[[0.0, -20.0, 0.0], [0.0, 20.0, 0.0]]]
    found = MapElements.from_polylines(line, [0], [0.9])
    truth = MapElements.from_polylines(line, [0])
    (matches,) = evaluator.match("t", found, truth).values()
    (like,) = evaluator.match_empty().values()
    again = matches_of("t", arrays_of(matches), like)
    wanted = arrays_of(matches)
    for key, values in arrays_of(again).items():
        np.testing.assert_array_equal(values, wanted[key])
    for key, values in wanted.items():
        with pytest.raises(ValueError, match="shapes"):
            matches_of("t", wanted | {key: values[None]}, like)
        with pytest.raises(ValueError, match="shapes"):
            matches_of("t", {k: v for k, v in wanted.items() if k != key}, like)
