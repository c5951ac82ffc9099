"""``infer --prior``, ``test --prior`` and a resumed training, on a tiny MiniCity."""

import json
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
import torch
from methods.hrmapnet.prior_cases import prior_model
from mmdet3d.registry import MODELS
from prior_cases import CLASSES
from processes import run_tool

from gsmap.apis.map_priors import empty_reads, open_priors
from gsmap.engine.launch import read_config
from gsmap.prior import LastSeen, MapPrior, PriorSettings, open_prior
from gsmap.utils.inputs import protect_inputs
from gsmap.utils.shards import digest
from tools import build_map, infer

PRIOR = """
_base_ = {base!r}
model = dict(prior=dict(
    type='RasterPrior', cell_m=0.6, score_threshold=0.0, bev=dict(layer=None, threshold=0.1),
    queries=dict(num_heads=4, stride=1, threshold=0.1)))
"""


@pytest.fixture(scope="module")
def config(tiny_config, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("prior") / "prior.py"
    path.write_text(PRIOR.format(base=str(tiny_config)))
    return path


@pytest.fixture(scope="module")
def model(config) -> list[str]:
    """The words after ``--model``."""
    torch.manual_seed(0)
    path = config.with_name("weights.pth")
    model = MODELS.build(read_config(config).model)
    model.init_weights()
    torch.save({"state_dict": model.state_dict()}, path)
    return [str(config), str(path)]


def lines_of(path):
    return {r["sample_token"]: r["vectors"] for r in json.loads(path.read_text())["results"]}


def test_a_prior_is_made_updated_and_only_read(model, minicity_annotations, tmp_path, capsys):
    path, drive = tmp_path / "town.prior", str(minicity_annotations["val"])

    def run(name, *words):
        out = tmp_path / f"{name}.json"
        with protect_inputs():  # as `run_command`
            infer.main([drive, "--model", *model, "--out", str(out), *map(str, words)])
        return lines_of(out)

    first = run("first", "--prior", path, "--update-prior")
    text = capsys.readouterr().out
    assert f"updated: {path}" in text
    assert "leak" not in text  # each sample is written after it is predicted
    with MapPrior.load(path) as prior:
        settings = PriorSettings(CLASSES, "boston-seaport", cell_m=0.6)
        assert prior.settings == settings
        assert prior.rule == LastSeen()
        assert prior.num_tiles > 0
    before = digest(path)
    second = run("second", "--prior", path)
    assert digest(path) == before
    count = len(second)
    leak = f"leak: {count} of {count} samples are among the {count} that the prior of 'boston-sea"
    assert leak in capsys.readouterr().out
    fact = {"place": "boston-seaport", "made_of": count, "also_predicted": count, "digest": before}
    assert json.loads((tmp_path / "second.json").read_text())["meta"]["priors"] == [fact]
    (fact,) = json.loads((tmp_path / "first.json").read_text())["meta"]["priors"]
    assert (fact["made_of"], fact["also_predicted"]) == (0, 0)
    assert second != first  # the map was empty then
    assert run("kept") == first  # without a prior, a map is kept from empty
    run("third", "--prior", path, "--update-prior")
    assert digest(path) != before
    with pytest.raises(ValueError, match="--shard cuts drives"):
        run("part", "--prior", path, "--shard", "1/2")


def test_priors_that_do_not_fit_are_refused(model, tiny_config, minicity_annotations, tmp_path):
    drive, out = str(minicity_annotations["val"]), str(tmp_path / "map.json")

    def run(path, *words, of=model):
        infer.main([drive, "--model", *of, "--out", out, "--prior", str(path), *words])

    def saved(name, classes=CLASSES, place="boston-seaport", cell_m=0.6):
        path = tmp_path / name
        MapPrior(PriorSettings(classes, place, cell_m=cell_m), LastSeen()).save(path)
        return path

    with pytest.raises(ValueError, match="has classes"):
        run(saved("classes", classes=CLASSES[:2]))
    with pytest.raises(ValueError, match=r"has cell_m 0\.3"):
        run(saved("cells", cell_m=0.3))
    with pytest.raises(ValueError, match=r"is in 'boston-seaport', and the priors are of \['oslo'"):
        run(saved("place", place="oslo"))
    with pytest.raises(FileNotFoundError):
        run(tmp_path / "nowhere")
    cut = saved("cut")
    cut.write_bytes(cut.read_bytes()[:-5])
    with pytest.raises(ValueError, match="cut"):
        run(cut)
    whole = saved("whole")
    with (
        MapPrior.load(whole, update=True),
        pytest.raises(RuntimeError, match="whole"),
    ):
        run(whole, "--update-prior")
    weights = tmp_path / "plain.pth"
    state = MODELS.build(read_config(tiny_config).model).state_dict()
    torch.save({"state_dict": state}, weights)
    with pytest.raises(ValueError, match="the model takes no prior"):
        run(whole, of=[str(tiny_config), str(weights)])
    with pytest.raises(SystemExit):
        infer.parse_args([drive, "--model", *model, "--out", out, "--update-prior"])


def test_a_prior_with_nothing_near_the_samples_is_named(
    model, minicity_annotations, tmp_path, capsys
):
    path, drive = tmp_path / "empty.prior", str(minicity_annotations["val"])
    settings = PriorSettings(CLASSES, "boston-seaport", cell_m=0.6)
    MapPrior(settings, LastSeen()).save(path)
    infer.main([drive, "--model", *model, "--out", str(tmp_path / "a.json"), "--prior", str(path)])
    count = len(lines_of(tmp_path / "a.json"))
    text = (
        f"the prior of 'boston-seaport' has nothing in the range of {count} of {count} samples, "
        "so it changed nothing: compare its global frame with that of the poses."
    )
    assert text in capsys.readouterr().out
    done = run_tool(
        "tools/test.py", *model, "--work-dir", tmp_path / "work", "--prior", path,
        "--out", tmp_path / "b.json", "--eval",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    assert text in done.stdout + done.stderr


def test_some_empty_windows_are_no_wrong_frame():
    prior = MapPrior(PriorSettings(CLASSES, "town"))
    assert empty_reads([prior]) == []
    prior.reads.add(is_empty=False)
    assert empty_reads([prior]) == []
    prior.reads.add(is_empty=True)
    text = "the prior of 'town' has nothing in the range of 1 of 2 samples."
    assert empty_reads([prior]) == [text]


def test_a_new_prior_is_of_the_place_without_one(tmp_path):
    model = prior_model().eval()
    first, second, third = (tmp_path / name for name in ("first.prior", "second.prior", "third"))

    def open_for(paths, *places):
        with ExitStack() as stack:
            priors = open_priors(model, paths, stack, update=True, places=places)
            return [prior.settings.place for prior in priors]

    assert open_for([first], "oslo") == ["oslo"]
    assert open_for([second, first], "oslo", "bergen") == ["bergen", "oslo"]
    assert open_for([third], "") == ["third"]
    third.unlink()
    for paths, places, reason in (
        ([third, first], ["oslo"], "third does not exist, and the .* are in no other place: make"),
        ([first, third], ["oslo", "a", ""], "are in a, an unknown place: make the prior of each"),
        ([third, tmp_path / "fourth"], ["a", "b"], "third and .*fourth do not exist, .* in a, b:"),
    ):
        with pytest.raises(ValueError, match=reason):
            open_for(paths, *places)
        assert not third.exists()


def test_predictions_of_a_run_without_update_are_not_used_with_it(model):
    words = ["drive", "--model", *model, "--out", "map.json", "--prior", "town.prior"]
    cfg = read_config(model[0])
    plain = infer.run_settings(infer.parse_args(words), cfg)
    assert infer.run_settings(infer.parse_args([*words, "--update-prior"]), cfg) != plain


def test_a_gaussian_prior_of_a_drive_is_read(model, minicity_annotations, tmp_path, capsys):
    drive = str(minicity_annotations["val"])
    path = tmp_path / "town.gaussians"
    found = {}
    for name, options in (
        ("empty", ["--cfg-options", "model.prior.test_memory=none"]),
        ("given", ["--prior", str(path)]),
    ):
        out = tmp_path / f"{name}.json"
        infer.main([drive, "--model", *model, "--out", str(out), *options])
        found[name] = lines_of(out)
        if name == "empty":
            content = json.loads(out.read_text())
            for record in content["results"]:
                for line in record["vectors"]:
                    line["confidence_level"] = 0.9  # the untrained model is sure of nothing
            out.write_text(json.dumps(content))
            words = ["--ann", drive, "--score-thr", "0", "--prior", str(path), "--gaussians"]
            build_map.main([str(out), *words])
    num_gaussians = open_prior(path).num_gaussians
    assert num_gaussians > 100
    assert f"prior of boston-seaport, {num_gaussians} Gaussians: {path}" in capsys.readouterr().out
    differences = []
    for token, lines in found["empty"].items():
        points = [line["pts"] for line in lines]
        from_prior = [line["pts"] for line in found["given"][token]]
        differences.append(np.abs(np.subtract(from_prior, points)).max())
    assert max(differences) > 0.1
    words = ["--out", str(tmp_path / "no.json"), "--prior", str(path), "--update-prior"]
    with pytest.raises(ValueError, match="has Gaussians, which a model can only read"):
        infer.main([drive, "--model", *model, *words])


def test_a_test_reads_a_prior(model, minicity_annotations, tmp_path):
    path = tmp_path / "town.prior"
    infer.main(
        [
            str(minicity_annotations["val"]), "--model", *model, "--out", str(tmp_path / "a.json"),
            "--prior", str(path), "--update-prior",
        ]
    )  # fmt: skip
    words = ["tools/test.py", *model, "--eval", "--work-dir", tmp_path / "work"]
    before = digest(path)
    found = {}
    for name, options in {"kept": [], "prior": ["--prior", path]}.items():
        out = tmp_path / f"{name}.json"
        done = run_tool(*words, "--out", out, *options)
        assert done.returncode == 0, done.stderr[-2000:]
        found[name] = lines_of(out)
        is_leak = name == "prior"
        text = done.stdout + done.stderr
        assert ("that the prior of 'boston-seaport' was made of" in text) == is_leak
        assert ("priors" in json.loads(out.read_text())["meta"]) == is_leak
    assert digest(path) == before
    inferred = lines_of(tmp_path / "a.json")
    for token, lines in found["kept"].items():
        points, others = ([line["pts"] for line in each] for each in (lines, inferred[token]))
        np.testing.assert_allclose(points, others, atol=1e-4)  # float32 sums in another order
        from_prior = [line["pts"] for line in found["prior"][token]]
        assert np.abs(np.subtract(from_prior, points)).max() > 0.1
    done = run_tool(*words, "--out", tmp_path / "b.json", "--prior", tmp_path / "nowhere")
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1
    assert "nowhere" in done.stderr


def test_a_resumed_training_is_equal_bit_for_bit(config, minicity_annotations, tmp_path):
    """The map is empty at the start of an epoch, so nothing of it is lost at its end."""
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    for folder, *runs in ((whole, 2), (parts, 1, 2)):
        for number, epochs in enumerate(runs):
            done = run_tool(
                "tools/train.py", config, "--work-dir", folder, *(["--resume"] if number else []),
                "--cfg-options", f"train_cfg.max_epochs={epochs}",
            )  # fmt: skip
            assert done.returncode == 0, done.stderr[-2000:]
    states = [torch.load(folder / "epoch_2.pth", weights_only=False) for folder in (whole, parts)]
    for name, value in states[0]["state_dict"].items():
        assert torch.equal(value, states[1]["state_dict"][name]), name
