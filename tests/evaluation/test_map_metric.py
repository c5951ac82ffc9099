"""The metric class as the runner calls it: batches, ranks, padding."""

import json
from argparse import Namespace

import numpy as np
import pytest
import torch

mmengine = pytest.importorskip("mmengine")
pytest.importorskip("mmdet3d")

from golden_data import CLASSES  # noqa: E402
from mmdet3d.registry import METRICS  # noqa: E402
from mmdet3d.structures import Det3DDataSample  # noqa: E402
from mmengine.config import Config  # noqa: E402
from mmengine.evaluator import Evaluator  # noqa: E402
from mmengine.structures import InstanceData  # noqa: E402

from gsmap.evaluation import map_metric  # noqa: E402
from gsmap.evaluation.core.results_json import read_samples  # noqa: E402
from tools.test import apply_options, metric_settings  # noqa: E402

RANGES = {"x_range": (-15.0, 15.0), "y_range": (-30.0, 30.0)}


def sample(token: str, shift: float, truth: bool = True) -> Det3DDataSample:
    """A divider predicted ``shift`` metres beside itself."""
    y = torch.linspace(-20, 20, 20)
    line = torch.stack([torch.zeros(20), y], dim=1)
    info = {"polylines": [line.numpy()], "labels": np.array([0])} if truth else None
    found = Det3DDataSample(metainfo={"token": token, "eval_ann_info": info})
    found.pred_instances_3d = InstanceData(
        pts=(line + torch.tensor([shift, 0.0]))[None],
        scores_3d=torch.tensor([1.0 - shift / 10]),
        labels_3d=torch.tensor([0]),
        scales=torch.ones(1, 20, 2),
        rotations=torch.zeros(1, 20),
    )
    return found


def build(**settings) -> Evaluator:
    evaluator = Evaluator(METRICS.build({"type": "MapMetric", **settings}))
    evaluator.dataset_meta = {"classes": CLASSES, **RANGES}
    return evaluator


def test_figures_through_the_runner_do_not_count_padding():
    evaluator = build()
    evaluator.process([sample("a", 0.1), sample("b", 0.8)])
    evaluator.process([sample("c", 0.3), sample("a", 0.1)])  # the last batch is padded
    metrics = evaluator.evaluate(3)
    assert metrics["chamfer/divider/AP@0.5"] == pytest.approx(2 / 3)
    assert metrics["chamfer/divider/AP@1.0"] == 1.0
    assert metrics["chamfer/divider/num_preds"] == 3
    assert metrics["raster/num_samples"] == 3


def test_a_full_disk_does_not_take_the_figures(monkeypatch):
    shown = []

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(map_metric, "write_results", full)
    monkeypatch.setattr(map_metric, "format_table", lambda report: shown.append(report.name))
    evaluator = build(out_file="results.json")
    evaluator.process([sample("a", 0.1)])
    with pytest.raises(OSError, match="No space left"):
        evaluator.evaluate(1)
    assert shown == ["chamfer", "raster"]


def test_any_order_and_any_split_over_ranks_gives_the_same_digits(monkeypatch):
    samples = [sample(f"s{i}", 0.07 * i) for i in range(9)]
    alone = build()
    alone.process(samples)
    want = alone.evaluate(9)
    ranks = [build(), build()]
    for rank, evaluator in enumerate(ranks):
        evaluator.process([*samples[rank::2], samples[0]][:5][::-1])
    metric = ranks[0].metrics[0]
    metric.results += ranks[1].metrics[0].results  # what collect_results hands to the first rank
    assert metric.evaluate(9) == want


@pytest.mark.parametrize(("prefix", "key"), [(None, "chamfer/mAP"), ("a", "a/chamfer/mAP")])
def test_keys_have_a_prefix_only_if_asked_for_and_mmengine_does_not_warn(prefix, key, monkeypatch):
    said = []
    monkeypatch.setattr("mmengine.evaluator.metric.print_log", lambda text, **_: said.append(text))
    evaluator = build(eval=["chamfer"], prefix=prefix)
    evaluator.process([sample("a", 0.1)])
    assert key in evaluator.evaluate(1)
    assert not said


def test_results_are_written_with_gaussians_and_without_ground_truth(tmp_path):
    path = tmp_path / "results.json"
    evaluator = build(eval=[], out_file=str(path))
    of_model = {"checkpoint": "0" * 64, "calibration": {"law": "laplace", "sigmas": 1.0}}
    evaluator.dataset_meta = {**evaluator.dataset_meta, **of_model, "split": "val"}
    evaluator.process([sample("b", 0.2, truth=False), sample("a", 0.1, truth=False)])
    assert evaluator.evaluate(2) == {}
    written = json.loads(path.read_text())
    assert [sample["sample_token"] for sample in written["results"]] == ["a", "b"]
    vector = written["results"][1]["vectors"][0]
    assert vector["cls_name"] == "divider"
    assert vector["pts"][0] == pytest.approx([0.2, -20.0])
    assert len(vector["gaussian_rotations"]) == 20
    assert written["meta"] == {"classes": list(CLASSES), **of_model}


def raised(found: Det3DDataSample, predicted_m: float) -> Det3DDataSample:
    """Lay the ground truth at z = 0 and the prediction at another height."""
    (line,), pts = found.eval_ann_info["polylines"], found.pred_instances_3d.pts
    found.eval_ann_info["polylines"] = [np.c_[line, np.zeros(len(line))]]
    found.pred_instances_3d.pts = torch.cat([pts, torch.full((1, 20, 1), predicted_m)], -1)
    return found


def test_heights_count_where_the_data_set_hands_them_on(tmp_path):
    """The data set's dim decides: 1.2 m too high misses the thresholds below."""
    path, wanted = tmp_path / "results.json", {2: (1.0, 1.0), 3: (0.0, 1.0)}
    for dim, aps in wanted.items():
        evaluator = build(out_file=str(path))
        evaluator.dataset_meta = {**evaluator.dataset_meta, "dim": dim}
        evaluator.process([raised(sample("a", 0.0), 1.2)])
        metrics = evaluator.evaluate(1)
        assert tuple(metrics[f"chamfer/divider/AP@{t}"] for t in (1.0, 1.5)) == aps
        assert metrics["raster/divider/AP"] == pytest.approx(1.0)
    (vector,) = json.loads(path.read_text())["results"][0]["vectors"]
    assert vector["pts"][0] == pytest.approx([0.0, -20.0, 1.2])
    read, _ = read_samples(path, "results", CLASSES)
    assert read["a"].points.shape == (20, 3)
    np.testing.assert_allclose(read["a"].points[:, 2], 1.2, rtol=1e-6)


def test_samples_without_ground_truth_and_bad_settings_are_refused():
    with pytest.raises(ValueError, match="sample x has no ground truth"):
        build().process([sample("x", 0.1, truth=False)])
    with pytest.raises(ValueError, match=r"there is no metric \['mIoU'\]; there are .'chamfer', "):
        map_metric.MapMetric(eval=["mIoU"])
    with pytest.raises(ValueError, match="eval must name metrics"):
        map_metric.MapMetric(eval=[])
    nameless = Evaluator(map_metric.MapMetric())
    with pytest.raises(ValueError, match="a data set whose metainfo has classes"):
        nameless.process([sample("x", 0.1)])


def test_a_prediction_that_is_not_finite_names_its_sample():
    broken = sample("bad", 0.1)
    broken.pred_instances_3d.pts[0, 3, 0] = float("nan")
    with pytest.raises(ValueError, match=r"sample bad.*not finite"):
        build().process([broken])


def test_the_metrics_of_a_test_are_given_as_mmengine_takes_them():
    plain = {"type": "MapMetric", "dim": 3}
    dump = {"type": "DumpResults", "out_file_path": "a.pkl"}
    for given, expected in (
        (None, [{"type": "MapMetric"}]),
        ({"dim": 3}, [plain]),
        (plain, [plain]),
        ([dump, plain], [plain, dump]),
        ([dump], [{"type": "MapMetric"}, dump]),
        (dump, [{"type": "MapMetric"}, dump]),
        ({"type": "Evaluator", "metrics": [plain, dump]}, [plain, dump]),
        ({"metrics": plain}, [plain]),
    ):
        assert metric_settings(Config({"test_evaluator": given})) == expected


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, {"eval": ["chamfer"], "out_file": "a.json"}),
        ({"eval": ["raster"]}, {"eval": ["raster"], "out_file": "a.json"}),
        ({"eval": [], "out": "b.json"}, {"eval": [], "out_file": "b.json"}),
    ],
)
def test_metrics_of_the_config_are_those_of_a_test_without_the_option(options, expected):
    given = {"type": "MapMetric", "eval": ["chamfer"], "out_file": "a.json"}
    cfg = Config({"test_evaluator": given})
    nothing = {"eval": None, "out": None, "show_dir": None, "shuffle_images": None}
    apply_options(cfg, Namespace(allow_other_split=False, **{**nothing, **options}))
    assert cfg.test_evaluator[0] == {"type": "MapMetric", **expected}
