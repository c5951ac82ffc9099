"""Comparisons: what is refused before anything trains, and the arithmetic of the tables."""

import json
import os
import re
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from comparison.jobs import Job
from comparison.plan import Protocol, Run, parse_entry, plan
from comparison.results import check_one_test_set, evaluator_for, read_result, rescore
from comparison.tables import as_json, differences_to_first, markdown
from mmdet3d.registry import DATA_SAMPLERS
from torch.utils.data import BatchSampler

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.engine.torchrun import OWN_WORDS
from gsmap.evaluation.core.results_json import vectors_of, write_results
from gsmap.structures.elements import MapElements
from gsmap.utils.faults import user_message
from tools.compare import main as compare
from tools.compare import rate_note

CLASSES = ("divider", "boundary")


def test_entries_are_read_with_commas_in_values():
    assert parse_entry("configs/maptr/a.py") == ("a", "configs/maptr/a.py", ())
    assert parse_entry("b=c.py,x.y=[1,2],z=(a,b),q=1e-3") == (
        *("b", "c.py", ("x.y=[1,2]", "z=(a,b)", "q=1e-3")),
    )
    nested = ("x=[[1,2],[3,4]]", "y=[(a,b),(c,d)]", "z=1")
    assert parse_entry(",".join(["b=c.py", *nested])).options == nested
    for unbalanced in ("x=(,y=2", "x=1),y=2", "x=)(,y=2"):
        with pytest.raises(ValueError, match="close each bracket that you open"):
            parse_entry(f"b=c.py,{unbalanced}")
    with pytest.raises(ValueError, match="'typo' is no override; write KEY=VALUE"):
        parse_entry("b=c.py,typo")
    with pytest.raises(ValueError, match=r"got '\.\./b'"):
        parse_entry("../b=c.py")


@pytest.fixture
def protocol(tmp_path) -> Protocol:
    return Protocol(seeds=2, budget=3, out=tmp_path / "out", batch=2)


def entries(tiny_config: Path, *texts: str):
    return [parse_entry(text.replace("CONFIG", str(tiny_config))) for text in texts]


def test_runs_are_planned_with_one_budget_seed_by_seed(tiny_config, protocol):
    runs = plan(entries(tiny_config, "a=CONFIG", "b=CONFIG,optim_wrapper.optimizer.lr=1"), protocol)
    assert [run.label for run in runs] == ["a/seed_0", "b/seed_0", "a/seed_1", "b/seed_1"]
    assert {run.epochs for run in runs} == {3}  # two samples, two a step
    assert runs[3].settings["randomness"]["seed"] == 1
    assert runs[3].settings["optim_wrapper"]["optimizer"]["lr"] == 1
    assert not protocol.out.exists()  # nothing is written yet


def test_learning_rates_for_different_batches_are_named(tiny_config, protocol):
    rate = "optim_wrapper.optimizer.lr=1"
    runs = plan(entries(tiny_config, "a=CONFIG", f"b=CONFIG,{rate}"), protocol)
    assert rate_note(runs, batch=2) == ""
    size = "auto_scale_lr.base_batch_size"
    texts = [f"a=CONFIG,{size}=32", f"b=CONFIG,{size}=16", f"c=CONFIG,{rate},{size}=16"]
    runs = plan(entries(tiny_config, *texts), protocol)
    note = rate_note(runs, batch=2)
    assert "for batches of 16 (b, c) and 32 (a); here a batch has 2" in note


@pytest.mark.parametrize(
    ("evaluator", "option"),
    [
        ("dict(type='MapMetric')", "val_evaluator.eval"),
        ("[dict(type='LyftMetric'), dict(type='MapMetric')]", "val_evaluator.1.eval"),
        ("dict(_delete_=True, metrics=[dict(type='MapMetric')])", "val_evaluator.metrics.0.eval"),
        ("dict(_delete_=True, metrics=dict(type='MapMetric'))", "val_evaluator.metrics.eval"),
    ],
)
def test_a_validation_may_have_further_metrics(evaluator, option, tiny_config, protocol, tmp_path):
    leaf = tmp_path / "leaf.py"
    leaf.write_text(f"_base_ = '{tiny_config}'\nval_evaluator = {evaluator}\n")
    run, *_ = plan(entries(leaf, "a=CONFIG"), protocol)
    assert run.options[1] == f"{option}=chamfer,raster"


def test_a_validation_without_figures_to_compare_is_refused(tiny_config, protocol, tmp_path):
    leaf = tmp_path / "leaf.py"
    leaf.write_text(f"_base_ = '{tiny_config}'\nval_evaluator = [dict(type='LyftMetric')]\n")
    with pytest.raises(ValueError, match=r"leaf\.py: val_evaluator has no MapMetric"):
        plan(entries(leaf, "a=CONFIG"), protocol)


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (["a=CONFIG", "a=CONFIG"], "two configs have one name"),
        (["a=CONFIG", "b=CONFIG,test_evaluator.eval=[raster]"], "a and b would be the same run"),
        (["nowhere.py"], "no config file nowhere.py"),
        (
            ["a=CONFIG", "b=CONFIG,test_dataloader.dataset.split=train"],
            "use different data: test.spl",
        ),
        (["a=CONFIG,train_cfg.max_epochs=5"], "leave it out"),
        (
            ["a=CONFIG", "b=CONFIG,optim_wrapper.accumulative_counts=2"],
            r"different numbers of optimizer steps: .*accumulative_counts: 1 and 2\. Set one",
        ),
        (["a=CONFIG,model.map_head.no_such_part=1"], "no_such_part"),
        (["a=CONFIG,optim_wraper.x=1"], "did you mean 'optim_wrapper'"),
    ],
)
def test_bad_input_is_refused_before_anything_trains(tiny_config, protocol, texts, message):
    with pytest.raises((ValueError, FileNotFoundError, TypeError), match=message):
        plan(entries(tiny_config, *texts), protocol)
    assert not protocol.out.exists()


@pytest.mark.parametrize(
    "option",
    [
        "train_dataloader.dataset.shuffle_images_seed=1",
        "train_dataloader.sampler.shuffle=False",
        "default_hooks.sync_buffers=None",
        "load_from=gsmap_r18_minicity",
        "auto_scale_lr.enable=True",
    ],
)
def test_what_is_no_part_of_the_model_makes_another_run_too(tiny_config, protocol, option):
    one, other, *_ = plan(entries(tiny_config, "a=CONFIG", f"b=CONFIG,{option}"), protocol)
    one.folder.mkdir(parents=True)
    (one.folder / "settings.json").write_text(json.dumps(other.settings))
    with pytest.raises(ValueError, match="holds a run of other settings"):
        plan(entries(tiny_config, "a=CONFIG"), protocol)


def test_a_work_folder_of_an_earlier_version_is_continued(tiny_config, protocol):
    config = entries(tiny_config, "a=CONFIG,load_from=gsmap_r18_minicity")
    (run, _) = plan(config, protocol)
    run.folder.mkdir(parents=True)
    settings = {**run.settings}
    for key in ("auto_scale_lr", "load_from", "sync_bn"):
        settings.pop(key)
    (run.folder / "settings.json").write_text(json.dumps(settings))
    assert len(plan(config, protocol)) == 2


def test_a_budget_is_whole_epochs_and_a_folder_one_run(tiny_config, protocol):
    config = entries(tiny_config, "a=CONFIG")
    with pytest.raises(ValueError, match=r"no whole number of epochs of a \(2 iterations each\)"):
        plan(config, replace(protocol, batch=1))
    (run, _) = plan(config, protocol)
    run.folder.mkdir(parents=True)
    (run.folder / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match="holds something else"):
        plan(config, protocol)
    (run.folder / "settings.json").write_text(json.dumps(run.settings))
    assert len(plan(config, protocol)) == 2
    message = r"seed_0 holds a run of other settings: optim_wrapper.optimizer.lr: 0.0006 and 0.001"
    with pytest.raises(ValueError, match=message):
        plan(config, replace(protocol, options=("optim_wrapper.optimizer.lr=0.001",)))


class OneBatch(BatchSampler):
    """Batch sampler of one batch of an epoch."""

    def __init__(self, sampler, batch_size):
        super().__init__(sampler, batch_size, drop_last=True)

    def __len__(self):
        return 1


@pytest.mark.parametrize(
    ("cores", "loader", "steps"),
    [
        (1, "", 2),
        (1, "drop_last=True", 1),
        (2, "drop_last=True", 2),  # a sampler gives each of two processes two samples
        (1, "sampler=dict(_delete_=True, type='StreamTrainSampler', slots=2)", 1),
        (2, "sampler=dict(_delete_=True, type='StreamTrainSampler', slots=1)", 1),
        (1, "num_batch_per_epoch=3", 3),
        (1, "batch_sampler=dict(type='OneBatch')", 1),
        (1, "sampler=None", 2),
        (1, "num_workers=1, multiprocessing_context='fork'", 2),
    ],
)
def test_an_epoch_has_the_steps_of_its_data_loader(
    cores, loader, steps, tiny_config, protocol, tmp_path, monkeypatch
):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)))
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    monkeypatch.setitem(DATA_SAMPLERS.module_dict, "OneBatch", OneBatch)
    leaf = tmp_path / "leaf.py"
    leaf.write_text(f"_base_ = '{tiny_config}'\ntrain_dataloader = dict({loader})\n")
    config = entries(leaf, "a=CONFIG,train_dataloader.dataset.indices=[0,1,0]")
    (run, _) = plan(config, replace(protocol, budget=6))
    assert run.epochs == 6 / steps


def test_runs_that_accumulate_equally_are_compared(tiny_config, protocol):
    options = "optim_wrapper.accumulative_counts=2"
    texts = f"a=CONFIG,{options}", f"b=CONFIG,{options},optim_wrapper.optimizer.lr=1"
    assert len(plan(entries(tiny_config, *texts), protocol)) == 4


@pytest.mark.parametrize(
    ("scheduler", "epochs", "scaled"),
    [
        # of 110 epochs
        ("type='MultiStepLR', milestones=[77, 99]", 110, {"milestones": [77, 99]}),
        ("type='MultiStepLR', milestones=[77, 99]", 220, {"milestones": [154, 198]}),
        ("type='MultiStepLR', milestones=[77, 99]", 20, {"milestones": [14, 18]}),
        ("type='MultiStepLR', milestones=[77, 99]", 3, {"milestones": [1, 2]}),  # not 2 and 3
        ("type='MultiStepLR', milestones=[1, 2, 3]", 11, {"milestones": [1, 2, 3]}),
        ("type='MultiStepLR', milestones=[107, 108, 109]", 11, {"milestones": [8, 9, 10]}),
        # 100 epochs after the first 10, then 50 after the first 10
        ("type='MultiStepLR', milestones=[80], begin=10", 60, {"milestones": [40]}),
        ("type='MultiStepLR', milestones=[9], by_epoch=False", 20, {"milestones": [9]}),
        ("type='CosineAnnealingLR', T_max=900, begin=5, by_epoch=False", 20, {"T_max": 15}),
        ("type='CosineAnnealingLR', T_max=44, end=44", 60, {"T_max": 44, "end": 44}),
        ("type='CosineAnnealingLR', T_max=66, begin=44, end=110", 60, {"T_max": 16, "end": 60}),
        ("type='PolyLR', end=110", 60, {"end": 60}),
        ("type='StepLR', step_size=10", 33, {"step_size": 3}),
        ("type='StepLR', step_size=10", 2, {"step_size": 1}),
        ("type='CosineAnnealingLR', T_max=100, begin=10", 60, {"T_max": 50}),
    ],
)
def test_schedules_over_epochs_take_the_length_of_the_budget(
    scheduler, epochs, scaled, tiny_config, protocol, tmp_path
):
    leaf = tmp_path / "leaf.py"
    leaf.write_text(
        f"_base_ = '{tiny_config}'\ntrain_cfg = dict(max_epochs=110)\n"
        f"param_scheduler = [dict({scheduler})]\n"
    )
    (run, _) = plan(entries(leaf, "a=CONFIG"), replace(protocol, budget=epochs))
    assert run.epochs == epochs
    (settings,) = run.settings["param_scheduler"]
    assert {name: settings[name] for name in scaled} == scaled


@pytest.mark.parametrize(
    ("scheduler", "epochs", "reason"),
    [
        (
            "milestones=[77, 99]",
            2,
            r"too few .* 2 milestones: .* param_scheduler\.0\.milestones=\[",
        ),
        ("milestones=[77, 110]", 20, r"set param_scheduler\.0\.milestones .* below 20"),
        ("milestones=[77, 400]", 20, r"set param_scheduler\.0\.milestones .* below 20"),
        ("milestones=[9, 20], by_epoch=False", 20, "lasts 20 iterations .* comes after 20"),
    ],
)
def test_milestones_after_the_budget_are_refused(
    scheduler, epochs, reason, tiny_config, protocol, tmp_path
):
    leaf = tmp_path / "leaf.py"
    leaf.write_text(
        f"_base_ = '{tiny_config}'\ntrain_cfg = dict(max_epochs=110)\n"
        f"param_scheduler = [dict(type='MultiStepLR', {scheduler})]\n"
    )
    longer = replace(protocol, budget=epochs)
    with pytest.raises(ValueError, match=reason):
        plan(entries(leaf, "a=CONFIG"), longer)
    # The user's override takes precedence.
    option = "param_scheduler.0.milestones=[1]"
    (run, _) = plan(entries(leaf, f"a=CONFIG,{option}"), longer)
    assert run.settings["param_scheduler"][0]["milestones"] == [1]


def test_an_epoch_without_a_whole_batch_is_refused(tiny_config, protocol):
    config = entries(tiny_config, "a=CONFIG,train_dataloader.drop_last=True")
    with pytest.raises(ValueError, match="an epoch of a has no iteration: train_dataload"):
        plan(config, replace(protocol, batch=64))


def test_a_comparison_keeps_its_number_of_processes(tiny_config, protocol, tmp_path, monkeypatch):
    """Runs on a GPU are tabulated on a node without one; runs on a CPU cannot go on on a GPU."""
    config = entries(tiny_config, "a=CONFIG")
    on_cpu = replace(protocol, out=tmp_path / "cpu")
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    for gpus, at in ((1, protocol), (0, on_cpu)):
        monkeypatch.setattr(torch.cuda, "device_count", lambda gpus=gpus: gpus)
        (run, _) = plan(config, at)
        assert run.processes == 2 - gpus
        run.folder.mkdir(parents=True)
        (run.folder / "settings.json").write_text(json.dumps(run.settings))
    assert [run.processes for run in plan(config, protocol)] == [1, 1]
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    with pytest.raises(ValueError, match=r"a run of other settings: .*processes: 2 and 1"):
        plan(config, on_cpu)


def test_a_run_is_worked_on_once_at_a_time(tmp_path):
    run = Run("a", 0, tmp_path / "a", "a.py", (), 1, 1, 1, {})
    job = Job(run, None)  # there is no a.py: it fails at once
    with pytest.raises(RuntimeError, match="is in use by"):
        Job(run, None)
    job.end("cut off")
    assert json.loads((run.folder / "run.json").read_text())["state"] == "cut off"
    Job(run, None).end("cut off")


def finished(folder: Path, divider: float, boundary: float, num_gts: int = 7) -> Path:
    """Write the metrics of a run."""
    folder.mkdir(parents=True)
    figures = {f"{m}/{c}/num_gts": num_gts for m in ("chamfer", "raster") for c in CLASSES}
    for metric in ("chamfer", "raster"):
        figures[f"{metric}/divider/AP"] = divider
        figures[f"{metric}/boundary/AP"] = boundary
        figures[f"{metric}/mAP"] = (divider + boundary) / 2
    (folder / "metrics.json").write_text(json.dumps(figures))
    return folder


def test_means_spread_and_paired_differences_by_hand(tmp_path):
    """A: 0.2, 0.4; B, seed by seed 0.1 and 0.2 above it; C was cut off."""
    results = []
    for name, seed, divider in (("A", 0, 0.2), ("B", 0, 0.3), ("A", 1, 0.4), ("B", 1, 0.6)):
        folder = finished(tmp_path / name / str(seed), divider, divider)
        results.append(read_result(name, folder, seed))
    (tmp_path / "C").mkdir()
    (tmp_path / "C/run.json").write_text('{"state": "train ended with exit code -9: train.log"}')
    results.append(read_result("C", tmp_path / "C", 0))
    lines = markdown(results, "Comparison", "python tools/compare.py").splitlines()
    row = {line.split(" | ")[0]: line for line in reversed(lines)}
    assert row["| A"] == "| A | 2 |" + " 30.0 ± 14.1 |" * 6
    assert row["| B"] == "| B | 2 |" + " 45.0 ± 21.2 |" * 6
    assert row["| C"] == "| C | 0 (1 not done) |" + " - |" * 6
    assert "| B | 2 |" + " +15.0 ± 7.1 |" * 6 in lines
    assert any("train ended with exit code -9: train.log" in line for line in lines)
    assert differences_to_first(results)["B"]["raster/mAP"] == pytest.approx([0.1, 0.2])
    assert "`python tools/compare.py`" in lines


@pytest.mark.parametrize(
    ("runs", "expected", "without_pair"),
    [
        ("A0 A0 B0", [], "012"),
        ("A0 B0 B0", [], "012"),
        ("A? B? B0", [], "012"),
        ("A0 A0 A1 B0 B1", [0.2], "013"),
        ("A0 B0 C1", [0.1], "2"),
        ("A0 A1", [], ""),
    ],
)
def test_only_runs_with_one_partner_are_paired(runs, expected, without_pair, tmp_path):
    """Run i, which is named by its config and its seed, has an AP of i / 10."""
    results = []
    for number, (name, seed) in enumerate(runs.split()):
        folder = finished(tmp_path / str(number), number / 10, number / 10)
        results.append(read_result(name, folder, None if seed == "?" else int(seed)))
    found = differences_to_first(results).get("B", {}).get("raster/mAP", [])
    assert found == pytest.approx(expected)
    folders = [str(tmp_path / number) for number in without_pair]
    assert json.loads(as_json(results, "", ""))["without_pair"] == folders
    text = markdown(results, "", "")
    assert ("Runs without a pair" in text) == bool(folders)
    assert ", ".join(folders) in text


def with_config(folder: Path, text: str | None) -> Path:
    """Write a run with a log, and a config that it noted."""
    noted = finished(folder, 0.5, 0.5) / "20260101_000000/vis_data"
    noted.mkdir(parents=True)
    (noted / "scalars.json").write_text('{"loss": 1.0, "time": 0.1, "step": 5}\n')
    if text is not None:
        (noted / "config.py").write_text(text)
    return folder


def test_the_config_in_a_runs_folder_says_seed_and_data_and_is_not_run(
    minicity_annotations, tmp_path
):
    path = minicity_annotations["val"]
    dataset = f"dict(data_root='{path.parent}/', ann_file='{path.name}')"
    text = f"randomness = dict(seed=7)\ntest_dataloader = dict(dataset={dataset})\n"
    result = read_result("a", with_config(tmp_path / "good", text))
    assert result.seed == 7
    with pytest.raises(
        FileNotFoundError, match=r"results\.json"
    ):  # the data is found, no predictions
        rescore(result, {})
    marker = tmp_path / "marker"
    attacks = {
        f"import pathlib; pathlib.Path({str(marker)!r}).touch()": "only assignments",
        f"randomness = dict(seed=open({str(marker)!r}, 'w'))": r"calls of open\(\)",
        "_base_ = 'evil.py'\nrandomness = dict(seed='x')": "must be a number, got 'x'",
        None: r"config of its run, 2\*/vis_data/config.py, which tools/train.py writes",
    }
    for number, (attack, message) in enumerate(attacks.items()):
        folder = with_config(tmp_path / f"bad{number}", attack)
        (folder / "20260101_000000/vis_data/evil.py").write_text(f"open({str(marker)!r}, 'w')")
        with pytest.raises(ValueError, match=message):
            read_result("a", folder)
    assert not marker.exists()


@pytest.mark.parametrize("content", ["[]", '"x"', '{"processes": "x"}', "[" * 5000])
def test_a_runs_notes_of_another_kind_are_named(content, tiny_config, protocol, tmp_path):
    (folder := protocol.out / "a/seed_0").mkdir(parents=True)
    (folder / "settings.json").write_text(content)
    with pytest.raises((ValueError, RecursionError)) as raised:
        plan(entries(tiny_config, "a=CONFIG"), protocol)
    assert "seed_0/settings.json" in user_message(raised.value)


def test_results_of_different_ground_truth_are_refused(tmp_path):
    folders = [finished(tmp_path / "a", 0, 0), finished(tmp_path / "b", 0, 0, num_gts=8)]
    with pytest.raises(ValueError, match=r"a and .*b were tested on different data"):
        check_one_test_set([read_result("x", folder) for folder in folders])


def test_figures_that_do_not_exist_are_in_no_mean_and_no_difference(tmp_path):
    """The test set has no boundary, whose AP_raster is -1."""
    results = []
    for name, ap in (("a", 0.2), ("b", 0.5)):
        results.append(read_result(name, finished(tmp_path / name, ap, ap), 0))
        results[-1].figures["raster/boundary/AP"] = -1.0
    text = markdown(results, "", "")
    assert "| a | 1 | 20.0 | 20.0 | 20.0 | 20.0 | - | 20.0 |" in text
    assert "| b | 1 | +30.0 | +30.0 | +30.0 | +30.0 | - | +30.0 |" in text
    assert differences_to_first(results)["b"]["raster/boundary/AP"] == []


def test_only_the_metrics_of_the_tables_are_compared(tmp_path):
    results = [read_result(name, finished(tmp_path / name, 0.2, 0.2), 0) for name in "ab"]
    results[1].figures["topology/divider/num_gts"] = 3.0
    check_one_test_set(results)
    results[1].figures = {"pld/PLD": 0.5}
    with pytest.raises(ValueError, match=r"b/metrics.json has no figures of chamfer or raster"):
        check_one_test_set(results)


def test_a_test_of_some_samples_is_scored_again_on_these(minicity_annotations, tmp_path):
    path = minicity_annotations["val"]
    dataset = f"dict(data_root='{path.parent}/', ann_file='{path.name}', indices=1)"
    folder = with_config(tmp_path / "a", f"test_dataloader = dict(dataset={dataset})\n")
    result = read_result("a", folder, 0)
    result.figures["chamfer/num_samples"] = 1.0
    token = AnnotationFile(path).column("token")[0]
    write_results(folder / "results.json", [(token, [])])
    for report in rescore(result, {}):
        assert report.tokens == [token]
    result.figures["chamfer/num_samples"] = 2.0
    with pytest.raises(ValueError, match=r"results.json has 1 samples of .* and 2 were tested"):
        rescore(result, {})


def test_a_test_with_heights_is_scored_again_with_heights(minicity_annotations, tmp_path):
    path = minicity_annotations["val"]
    assert evaluator_for(path, {}).metrics[0].dim == 2
    assert evaluator_for(path, {}, dim=3).metrics[0].dim == 3
    assert evaluator_for(path, {"dim": 2}, dim=3).metrics[0].dim == 2
    assert evaluator_for(path, {}, dim=None).metrics[0].dim == AnnotationFile(path).meta.dim
    token = AnnotationFile(path).column("token")[0]
    for dim, error in ((2, None), (3, "AP_chamfer of dim 3")):
        dataset = f"dict(data_root='{path.parent}/', ann_file='{path.name}', indices=1, dim={dim})"
        folder = with_config(tmp_path / f"{dim}", f"test_dataloader = dict(dataset={dataset})\n")
        flat = vectors_of(MapElements.from_polylines([[[0.0, 0], [1, 1]]], [0], [0.9]), ["divider"])
        write_results(folder / "results.json", [(token, flat)])
        if error is None:
            rescore(read_result("a", folder, 0), {})
            continue
        with pytest.raises(ValueError, match=error):
            rescore(read_result("a", folder, 0), {})


def test_a_run_without_predictions_has_a_table_and_no_curves(tmp_path, monkeypatch, capsys):
    folder = finished(tmp_path / "a", 0.2, 0.2)
    words = ["--runs", f"A={folder}", "--out", str(tmp_path / "out")]
    monkeypatch.setattr(sys, "argv", ["compare.py", *words])
    assert "| A | 1 | 20.0 |" in compare()
    missing = r"a/results\.json is missing, the predictions of the test \(tools/test\.py --out\)"
    assert re.search(rf"a: no precision-recall curves\. .*{missing}", capsys.readouterr().out)
    monkeypatch.setattr(sys, "argv", ["compare.py", *words, "--rescore", "thresholds=[0.2]"])
    with pytest.raises(FileNotFoundError, match=missing):
        compare()


def test_seconds_of_a_test_are_those_of_a_batch_without_loading(tmp_path):
    folder = finished(tmp_path / "a", 0.2, 0.2)
    log = folder / "test/20260101_000000/20260101_000000.json"
    log.parent.mkdir(parents=True)
    log.write_text('{"data_time": 0.2, "time": 1.0}\n')
    assert read_result("a", folder, 0).costs == {"seconds a test batch": pytest.approx(0.8)}


def test_rules_of_both_metrics_may_change(minicity_annotations):
    path = minicity_annotations["val"]
    changes = {"thresholds": [0.2, 0.5], "polygon_classes": [], "ground_truth_points": 20}
    evaluator = evaluator_for(path, changes)
    chamfer, raster = evaluator.metrics
    assert evaluator.ground_truth_points == 20
    assert chamfer.thresholds == (0.2, 0.5)
    assert raster.polygon_classes == ()
    assert raster.grid.y_range == (-30.0, 30.0)
    assert evaluator_for(path, {"px_per_m": 4}).metrics[1].size_px == (120, 240)
    for wrong in ({"threshold": 1}, {"grid": 3}):  # the grid is the one of the file
        with pytest.raises(ValueError, match=r"no metric has the setting '\w+'; there are"):
            evaluator_for(path, wrong)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("ground_truth_points", 2.5),
        ("px_per_m", "a"),
        ("px_per_m", True),
        ("dilation_px", 7.5),
        ("resample_predictions", "no"),
        ("thresholds", 0.5),
    ],
)
def test_rules_of_another_type_are_refused(minicity_annotations, key, value):
    with pytest.raises(ValueError, match=f"{key} must be a value such as .*, got {value!r}"):
        evaluator_for(minicity_annotations["val"], {key: value})


class PrintingRun(Run):
    """A run whose training prints the lines of its config's name and fails."""

    def commands(self) -> dict[str, list[str]]:
        program = f"print({self.config!r}); raise SystemExit(2)"
        return {"train": [sys.executable, "-c", program], "test": []}


@pytest.mark.parametrize(
    ("printed", "cause"),
    [
        ("error: the cause\nerror: of a peer", "error: the cause"),
        (f"[rank0]: KeyError: 'a'\nerror: rank 0 ended {OWN_WORDS}", "[rank0]: KeyError: 'a'"),
        (f"error: the cause\nerror: rank 0 ended {OWN_WORDS}", "error: the cause"),
        ("KeyError: 'a'", "KeyError: 'a'"),
    ],
)
def test_a_run_that_fails_says_the_first_error_of_this_attempt(printed, cause, tmp_path):
    run = PrintingRun("a", 0, tmp_path / "a", printed, (), 1, 1, 1, {})
    run.folder.mkdir()
    (run.folder / "train.log").write_text("error: of an attempt before\n")
    job = Job(run, None)
    while not job.poll():
        time.sleep(0.01)
    record = json.loads((run.folder / "run.json").read_text())
    assert record["state"] == f"train ended with exit code 2 (train.log: {cause})"
    assert record["peak_mib"] > 0
