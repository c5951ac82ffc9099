import json
from types import SimpleNamespace

import numpy as np
import pytest
from comparison.run_curves import (
    plot_precision_recall,
    plot_runs,
    plot_series,
    read_run,
    smooth,
    summary_table,
)
from comparison.tables import plot_iterations

from gsmap.evaluation import ChamferConfig, MapEvaluator
from gsmap.structures.elements import MapElements
from gsmap.visualization.figure import figure_to_rgb
from tools import analyze_run


def write_log(folder, start, records):
    path = folder / start / "vis_data" / "scalars.json"
    path.parent.mkdir(parents=True)
    lines = [json.dumps(record) for record in records]
    path.write_text("\n".join(lines))
    return path


@pytest.fixture
def run(tmp_path):
    folder = tmp_path / "demo"
    first = [
        {"loss": 8.0, "loss_pts": 4.0, "d0.loss_pts": 5.0, "time": 0.5, "step": 1},
        {"loss": 4.0, "loss_pts": 2.0, "d0.loss_pts": 2.5, "time": 0.5, "step": 2},
        {"loss": 2.0, "loss_pts": 1.0, "d0.loss_pts": 1.25, "time": 0.5, "step": 4},
        {"chamfer/mAP": 0.25, "time": 0.1, "step": 1},
    ]
    write_log(folder, "20260101_000000", first)
    later = [
        {"loss": 1.0, "loss_pts": 0.5, "time": 0.7, "step": 4},
        {"loss": 1.0, "loss_pts": 0.5, "time": 0.7, "step": 8},
        {"chamfer/mAP": 0.75, "chamfer/divider/AP": 0.9, "step": 2},
        {"chamfer/mAP": 0.5, "step": 3},
    ]
    write_log(folder, "20260102_000000", later)
    return folder


def test_resumed_run_is_joined_and_the_later_record_counts(run):
    log = read_run(run)
    steps, values = log.series("loss")
    assert steps.tolist() == [1, 2, 4, 8]
    assert values.tolist() == [8, 4, 1, 1]
    assert log.series("chamfer/mAP", validation=True)[1].tolist() == [0.25, 0.75, 0.5]
    assert log.metrics == ["chamfer/mAP"]


def test_a_new_training_in_the_folder_of_another_replaces_it(tmp_path, monkeypatch, capsys):
    def log(start, losses, scores, interval=50, epoch=1):
        records = []
        for number, loss in enumerate(losses, start=1):
            records.append(
                {"loss": loss, "epoch": epoch, "step": (epoch - 1) * 200 + number * interval}
            )
        for number, score in enumerate(scores):
            records.append({"mAP": score, "step": epoch + number})
        write_log(tmp_path / "run", start, records)

    log("20260101_000000", [9.0] * 20, [0.1, 0.9])
    log("20260102_000000", [3.0] * 6, [0.2, 0.3])
    found = read_run(tmp_path / "run")
    assert found.num_replaced == 1
    assert found.series("loss")[1].tolist() == [3.0] * 6
    assert found.series("mAP", validation=True)[1].tolist() == [0.2, 0.3]
    # Resumed from the end of the first epoch, and stopped before the next validation.
    log("20260103_000000", [2.0], [], epoch=2)
    found = read_run(tmp_path / "run")
    assert found.num_replaced == 1
    assert found.series("loss")[1].tolist() == [3.0] * 4 + [2.0]
    assert found.series("mAP", validation=True)[1].tolist() == [0.2]
    monkeypatch.setattr("sys.argv", ["analyze_run.py", str(tmp_path / "run")])
    analyze_run.main()
    assert "not shown: 1 earlier training in the folder of run" in capsys.readouterr().out


def test_table_gives_last_and_best(run):
    rows = []
    for line in summary_table([read_run(run)]).split("\n"):
        cells = line.split("|")[1:-1]
        rows.append([cell.strip() for cell in cells])
    assert rows[0][-1] == "chamfer/mAP (last / best)"
    assert rows[2] == ["demo", "8", "8", "1", "0.6", "0.5 / 0.75"]


def test_only_a_mean_ap_has_a_best_value(tmp_path):
    """A smaller error is better. Names of metrics and classes may contain "map"."""
    names = ("newmap/divider/error_m@1.5", "pld/PLD", "raster/heatmap/AP")
    records = []
    for step, value in ((1, 0.9), (2, 0.5)):
        records.append({"step": step, "newmap/mAP": value} | dict.fromkeys(names, value))
    write_log(tmp_path / "a", "20260101_000000", records)
    log = read_run(tmp_path / "a")
    assert log.metrics == ["newmap/mAP"]
    assert summary_table([log]).splitlines()[2].split("|")[-2].strip() == "0.5 / 0.9"
    for record in records:
        del record["newmap/mAP"]
    write_log(tmp_path / "b", "20260101_000000", records)
    log = read_run(tmp_path / "b")
    assert log.metrics == list(names)
    heads, _, cells = (line.split("|") for line in summary_table([log]).splitlines())
    assert [head.strip() for head in heads[-4:-1]] == [f"{name} (last)" for name in names]
    assert [cell.strip() for cell in cells[-4:-1]] == ["0.5"] * 3


def test_plot_shows_total_parts_and_metrics(run):
    figure = plot_runs([read_run(run), read_run(run, "again")])
    total, parts, metrics = figure.axes
    assert [line.get_label() for line in parts.lines] == ["loss_pts"]
    np.testing.assert_allclose(metrics.lines[0].get_ydata(), [0.25, 0.75, 0.5])
    assert total.lines[1].get_label() == "demo"
    assert figure_to_rgb(figure).std() > 10


def test_chosen_figures_have_a_panel_each(tmp_path):
    log = [
        {"loss": 1.0, "at_floor": 0.5, "step": 1},
        {"loss": 1.0, "at_floor": 0.25, "step": 2},
    ]
    first = read_run(write_log(tmp_path, "a", log), "a")
    second = read_run(write_log(tmp_path, "b", log), "b")
    (panel,) = plot_series([first, second], ["at_floor"]).axes
    assert [line.get_label() for line in panel.lines[1::2]] == ["a", "b"]
    np.testing.assert_allclose(panel.lines[0].get_ydata(), [0.5, 0.25])
    with pytest.raises(ValueError, match=r"no run logged \['floor'\]"):
        plot_series([first], ["floor"])


def test_a_figure_that_is_always_zero_has_an_axis_that_can_be_read(tmp_path):
    log = [{"loss": 1.0, "at_floor": 0.0, "step": step} for step in (1, 2)]
    (panel,) = plot_series([read_run(write_log(tmp_path, "a", log), "a")], ["at_floor"]).axes
    assert max(panel.get_ylim()) >= 1.0


def test_values_that_are_not_finite_are_left_out(tmp_path):
    path = write_log(tmp_path, "a", [{"loss": float("nan"), "step": 1}, {"loss": 2.0, "step": 2}])
    assert read_run(path, "x").series("loss")[0].tolist() == [2]


def test_smoothed_is_a_centred_mean_that_starts_and_ends_as_the_values():
    np.testing.assert_allclose(smooth(np.array([2.0, 4, 6, 8])), [2, 4, 6, 8])  # too few
    values = np.zeros(40)
    values[[0, 20, 39]] = 5, 15, 3
    found = smooth(values)  # over five
    assert found[0] == 5
    assert found[-1] == 3
    np.testing.assert_allclose(found[[1, 17, 18, 20, 22, 23]], [5 / 3, 0, 3, 3, 3, 0])
    np.testing.assert_allclose(smooth(np.arange(100.0)), np.arange(100.0))  # it does not lag


def test_legends_stand_beside_the_curves_and_no_place_is_empty(run):
    figure = plot_runs([read_run(run)])
    figure_to_rgb(figure)
    total, parts, metrics = figure.axes
    for ax in figure.axes:
        assert ax.get_legend().get_window_extent().x0 >= ax.get_window_extent().x1
    assert metrics.get_position().x0 == pytest.approx(total.get_position().x0)
    assert metrics.get_position().x1 == pytest.approx(parts.get_position().x1, abs=0.1)
    assert max(metrics.get_ylim()) > 0.75  # the best point is whole


def test_unfinished_last_line_is_dropped_but_a_broken_one_is_named(tmp_path):
    path = write_log(tmp_path, "a", [{"loss": 1.0, "step": 1}])
    path.write_text(path.read_text() + '\n{"loss": 2.0, "st')
    assert len(read_run(tmp_path).train) == 1
    path.write_text('{"loss"\n{"loss": 1.0, "step": 1}')
    with pytest.raises(ValueError, match=r"scalars.json, line 1 is not JSON"):
        read_run(tmp_path)


def test_missing_log_and_no_runs(tmp_path):
    with pytest.raises(FileNotFoundError, match="No vis_data/scalars"):
        read_run(tmp_path)
    with pytest.raises(ValueError, match="at least one run that logged"):
        plot_runs([])


def test_validations_stand_at_the_ends_of_their_epochs_though_the_last_was_cut_off(tmp_path):
    log = [
        {"loss": 1.0, "step": 200, "epoch": 1},
        {"loss": 1.0, "step": 400, "epoch": 1},
        {"loss": 1.0, "step": 450, "epoch": 2},
        {"chamfer/mAP": 0.5, "step": 1},
    ]
    run = read_run(write_log(tmp_path, "a", log), "a")
    (panel,) = plot_iterations([SimpleNamespace(name="a", log=run)]).axes
    assert panel.lines[0].get_xdata().tolist() == [400]


def test_only_metrics_that_were_measured_have_a_panel(tmp_path):
    log = [
        {"loss": 1.0, "step": 1, "epoch": 1},
        {"chamfer/mAP": 0.5, "step": 1},
    ]
    run = read_run(write_log(tmp_path, "a", log), "a")
    result = SimpleNamespace(name="a", log=run)
    (panel,) = plot_iterations([result]).axes
    assert panel.get_title(loc="left") == "mAP_chamfer (%)"


def test_a_class_without_ground_truth_says_so_in_its_panel():
    gt = MapElements.from_polylines([[[0, 0], [0, 10]]], [0])
    pred = MapElements.from_polylines([[[0, 0], [0, 10]]], [0], [0.9])
    evaluator = MapEvaluator(ChamferConfig(("divider", "boundary")))
    reports = evaluator.reports([evaluator.match("a", pred, gt)])
    first, second = plot_precision_recall({"a": reports}).axes
    assert [text.get_text() for text in first.texts] == []
    assert [text.get_text() for text in second.texts] == ["no ground truth"]
