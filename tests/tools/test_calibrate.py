"""Sigmas of a result file: scored, drawn, fitted, and kept in a checkpoint."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from gsmap.apis.loading import load_model
from gsmap.checkpoints.reading import read_checked
from gsmap.datasets.annotations.file import write_annotations
from gsmap.datasets.annotations.record import AnnotationMeta, MapInstance, MapSample
from gsmap.evaluation.core.results_json import (
    GROUND_TRUTH_KEY,
    read_samples,
    vectors_of,
    write_results,
)
from gsmap.structures.elements import MapElements
from gsmap.utils.shards import digest
from tools.calibrate import main as calibrate
from tools.evaluate import main as evaluate

CLASSES = ("divider", "ped_crossing", "boundary")
NAME = "gsmap_r18_minicity"
ACROSS = "uncertainty/line/across/coverage@1"


@pytest.fixture
def files(tmp_path) -> tuple[Path, Path]:
    """40 samples with a line of each class, along y, whose points err by three sigmas across."""
    rng = np.random.default_rng(0)
    y = np.linspace(-20, 20, 20)
    found, truth = [], []
    for number in range(40):
        lines = [np.column_stack([np.full(20, x), y]) for x in (-5.0, 0.0, 5.0)]
        sigmas = rng.uniform(0.05, 0.15, (3, 20))
        moved = [
            line + np.column_stack([3 * rng.normal(size=20) * sigma, np.zeros(20)])
            for line, sigma in zip(lines, sigmas, strict=True)
        ]
        scales = [np.column_stack([np.full(20, 0.5), sigma]) for sigma in sigmas]
        angles = np.full((3, 20), np.pi / 2)
        elements = MapElements.from_polylines(moved, range(3), [0.9] * 3, scales, angles)
        found.append((f"t{number}", vectors_of(elements, CLASSES)))
        truth.append(
            (f"t{number}", vectors_of(MapElements.from_polylines(lines, range(3)), CLASSES))
        )
    write_results(tmp_path / "results.json", found)
    write_results(tmp_path / "truth.json", truth, key="GTs")
    return tmp_path / "results.json", tmp_path / "truth.json"


def test_a_checkpoint_keeps_what_is_fitted_and_its_model_has_it(files, tmp_path, monkeypatch):
    target = tmp_path / "calibrated.pth"
    words = ["calibrate.py", NAME, NAME, *map(str, files), str(target)]
    monkeypatch.setattr("sys.argv", words)
    assert "divider: sigma" in calibrate()
    temperatures = load_model(NAME, target).map_head.temperatures
    np.testing.assert_allclose([across for _, across in temperatures], 3.0, rtol=0.2)
    monkeypatch.setattr("sys.argv", [*words[:-1], str(tmp_path / "two.pth"), "--sigmas", "2"])
    calibrate()
    two = load_model(NAME, tmp_path / "two.pth").map_head.temperatures
    np.testing.assert_allclose([across for _, across in two], 3.0, rtol=0.2)
    assert two != temperatures
    monkeypatch.setattr("sys.argv", [*words[:-1], str(tmp_path / "tails.pth"), "--law", "laplace"])
    calibrate()
    tails = load_model(NAME, tmp_path / "tails.pth").map_head.temperatures
    np.testing.assert_allclose(np.divide(tails, temperatures)[:, 1], 1 / 0.8117, rtol=1e-3)
    monkeypatch.setattr("sys.argv", words)
    plain, fitted = load_model(NAME), load_model(NAME, target)
    assert plain.map_head.temperatures is None
    for name, value in plain.state_dict().items():
        assert value.equal(fitted.state_dict()[name])
    with pytest.raises(FileExistsError, match="exists already"):
        calibrate()
    monkeypatch.setattr(
        "sys.argv", [*words[:2], str(target), *words[3:-1], str(tmp_path / "again.pth")]
    )
    with pytest.raises(
        ValueError, match="is calibrated already: give the checkpoint it was made from"
    ):
        calibrate()


def test_the_split_that_a_model_was_trained_on_and_the_law_are_kept(files, tmp_path, monkeypatch):
    source, target = tmp_path / "trained.pth", tmp_path / "calibrated.pth"
    trained = {"dataset": "minicity", "split_list": f"near@{'0' * 16}", "cameras": ["CAM_FRONT"]}
    torch.save({"state_dict": read_checked(NAME).state, "meta": {"dataset_meta": trained}}, source)
    words = [NAME, str(source), *map(str, files), str(target), "--law", "laplace"]
    monkeypatch.setattr("sys.argv", ["calibrate.py", *words])
    assert calibrate().endswith(f"by the laplace law, 1 sigma: {target}")
    found = read_checked(target)
    assert found.trained_on == read_checked(source).trained_on == ("minicity", f"near@{'0' * 16}")
    assert found.dataset_meta == trained
    meta = torch.load(target, weights_only=True)["meta"]
    assert meta["calibration"] == found.calibration == {"law": "laplace", "sigmas": 1.0}


def test_samples_that_one_file_lacks_are_counted(files, tmp_path, monkeypatch):
    results, truth = (json.loads(path.read_text()) for path in files)
    results["results"] = results["results"][:30]
    truth["GTs"] = truth["GTs"][10:]
    for path, content in zip(files, (results, truth), strict=True):
        path.write_text(json.dumps(content))
    words = ["calibrate.py", NAME, NAME, *map(str, files), str(tmp_path / "a.pth")]
    monkeypatch.setattr("sys.argv", words)
    said = calibrate()
    assert "10 samples have no results, such as 't30'" in said
    assert "10 results have no ground truth, such as 't0': left out\n" in said


def test_predictions_of_another_checkpoint_are_refused(files, tmp_path, monkeypatch):
    source, target = tmp_path / "trained.pth", tmp_path / "calibrated.pth"
    torch.save({"state_dict": read_checked(NAME).state}, source)
    words = ["calibrate.py", NAME, str(source), *map(str, files), str(target)]
    monkeypatch.setattr("sys.argv", words)
    content = json.loads(files[0].read_text())
    files[0].write_text(json.dumps({**content, "meta": {"checkpoint": "0" * 64}}))
    with pytest.raises(ValueError, match=r"results.json was made with another checkpoint than .*t"):
        calibrate()
    assert not target.exists()
    files[0].write_text(json.dumps({**content, "meta": {"checkpoint": digest(source)}}))
    calibrate()
    assert target.exists()


def test_sigmas_are_not_fitted_on_the_split_of_the_training(files, tmp_path, monkeypatch):
    truth, _ = read_samples(files[1], GROUND_TRUTH_KEY, CLASSES)
    samples = [
        MapSample(
            token, "s", "town", i, [], np.eye(4),
            instances=[MapInstance(k, p) for p, k, _ in lines.rows],
        )
        for i, (token, lines) in enumerate(truth.items())
    ]  # fmt: skip
    source, trained = tmp_path / "trained.pth", {"dataset": "minicity", "split": "train"}
    torch.save({"state_dict": read_checked(NAME).state, "meta": {"dataset_meta": trained}}, source)
    for split in ("train", "val"):
        path = tmp_path / f"{split}.arrow"
        write_annotations(path, AnnotationMeta("minicity", "lidar", split), samples)
        target = tmp_path / f"of_{split}.pth"
        words = [NAME, str(source), str(files[0]), str(path), str(target)]
        monkeypatch.setattr("sys.argv", ["calibrate.py", *words])
        if split == "train":
            with pytest.raises(ValueError, match="split 'train', which the model was trained on"):
                calibrate()
        else:
            calibrate()
        assert target.exists() == (split == "val")
    path = tmp_path / "gsmap_minicity_train.arrow"  # of the config: the checkpoint names no split
    (tmp_path / "train.arrow").rename(path)
    words = [NAME, NAME, str(files[0]), str(path), str(tmp_path / "a.pth")]
    monkeypatch.setattr("sys.argv", ["calibrate.py", *words])
    with pytest.raises(ValueError, match="split 'train', which the model was trained on"):
        calibrate()


@pytest.mark.parametrize("sigmas", ["0", "-1", "3.1", "nan"])
def test_an_interval_of_no_or_too_many_sigmas_is_refused_at_once(sigmas, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["calibrate.py", *"abcde", "--sigmas", sigmas])
    with pytest.raises(SystemExit):
        calibrate()
    expected = "a number, got nan" if sigmas == "nan" else "more than 0 and at most 3"
    assert f"--sigmas must be {expected}" in capsys.readouterr().err


def test_a_model_without_gaussians_is_not_calibrated(files, tmp_path, monkeypatch):
    name, target = "maptr_r18_minicity", tmp_path / "calibrated.pth"
    monkeypatch.setattr("sys.argv", ["calibrate.py", name, name, *map(str, files), str(target)])
    with pytest.raises(ValueError, match="maptr_r18_minicity has no Gaussians"):
        calibrate()
    assert not target.exists()


def test_the_command_scores_and_draws_sigmas(files, tmp_path, capsys):
    out, curves = tmp_path / "figures.json", tmp_path / "curves.png"
    words = [*map(str, files), "--eval", "chamfer", "--out", str(out), "--uncertainty"]
    evaluate([*words, "--reliability", str(curves), "--pr-curves", str(tmp_path / "pr.png")])
    figures = json.loads(out.read_text())
    assert figures["uncertainty/divider/num_vertices"] == 800
    third = 0.2611  # of a normal distribution within a third of its sigma
    assert figures[ACROSS] == pytest.approx(third, abs=0.03)
    assert "chamfer/mAP" in figures
    evaluate([*words, "--law", "laplace", "--reliability", str(tmp_path / "laplace.png")])
    tails = json.loads(out.read_text())[ACROSS]
    assert tails == pytest.approx(0.2133, abs=0.03)  # within 0.8117 / 3 sigma
    said = json.loads(files[0].read_text())
    said["meta"] = {"calibration": {"law": "laplace", "sigmas": 1.0}}
    files[0].write_text(json.dumps(said))  # as the results of a calibrated model
    for law, share in (([], tails), (["--law", "normal"], figures[ACROSS])):
        evaluate([*words[:-1], *law, "--uncertainty"])
        assert json.loads(out.read_text())[ACROSS] == share
    assert (tmp_path / "laplace.png").read_bytes() != curves.read_bytes()
    assert curves.stat().st_size > 1000
    printed = capsys.readouterr().out
    laws = [line.split()[2] for line in printed.splitlines() if "matched vertices," in line]
    assert laws == ["normal", "laplace", "laplace", "normal"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--reliability", "a.png"], "--reliability needs --uncertainty"),
        (["--law", "laplace"], "--law needs --uncertainty"),
        (["--seed", "1"], "--seed is for resamples: give --bootstrap or --against"),
        (["--prior-elements", "9"], "--prior-elements needs --prior"),
        (
            ["--uncertainty", "--shard", "0/2", "--out", "a.json"],
            "--uncertainty needs all samples: leave out --shard",
        ),
    ],
)
def test_options_that_do_not_fit_are_refused(files, words, message, capsys):
    with pytest.raises(SystemExit):
        evaluate([*map(str, files), *words])
    assert message in capsys.readouterr().err
