"""``build_map --elements`` and ``--prior`` of ``infer`` and ``test``, on a tiny MiniCity."""

import json
from types import SimpleNamespace

import pytest
import torch
from mmdet3d.registry import MODELS

from gsmap.engine.launch import read_config
from gsmap.prior import ElementPrior
from gsmap.prior.sources import PriorSources
from gsmap.structures.elements import MapElements
from tools import build_map, infer
from tools.test import describe_priors

FUSION = ["--cfg-options", "model.prior.type=ElementFusion"]


@pytest.fixture(scope="module")
def model(tiny_config, tmp_path_factory) -> list[str]:
    """The words after ``--model``."""
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("elements") / "weights.pth"
    model = MODELS.build(read_config(tiny_config).model)
    model.init_weights()
    torch.save({"state_dict": model.state_dict()}, path)
    return [str(tiny_config), str(path)]


def lines_of(path):
    return {r["sample_token"]: r["vectors"] for r in json.loads(path.read_text())["results"]}


def test_elements_of_a_drive_are_fused(model, minicity_annotations, tmp_path, capsys):
    drive = str(minicity_annotations["val"])

    def run(name, *words):
        out = tmp_path / f"{name}.json"
        infer.main([drive, "--model", *model, "--out", str(out), *words])
        return out

    first = run("first")
    content = json.loads(first.read_text())
    for record in content["results"]:
        for line in record["vectors"]:
            line["confidence_level"] = 0.9  # the untrained model is sure of nothing
    first.write_text(json.dumps(content))
    path = tmp_path / "town.elements"
    words = [str(first), "--ann", drive, "--score-thr", "0", "--prior", str(path)]
    build_map.main([*words, "--elements", "--join"])
    prior = ElementPrior.load(path)
    assert len(prior.elements) > 3
    assert len(prior.sources) == len(content["results"]) == 2
    expected = f"prior of boston-seaport, {len(prior.elements)} elements: {path}"
    assert expected in capsys.readouterr().out
    second = lines_of(run("second", "--prior", str(path), *FUSION))
    assert "leak: 2 of 2 samples are among the 2 that the prior" in capsys.readouterr().out
    # A prior of one of the samples, and a run on the other one.
    del content["results"][0]
    first.write_text(json.dumps(content))
    other = str(tmp_path / "other.elements")
    build_map.main([*words[:-1], other, "--elements", "--join"])
    run("third", "--prior", other, *FUSION)
    assert "leak: 1 of 2 samples are among the 1 that the prior" in capsys.readouterr().out
    tokens = [token for token in second if token != content["results"][0]["sample_token"]]
    run("fourth", "--prior", other, "--token", *tokens, *FUSION)
    assert "leak" not in capsys.readouterr().out
    plain = lines_of(run("plain", *FUSION))
    assert plain == lines_of(run("unset"))
    assert plain.keys() == second.keys()
    assert plain != second
    highest = max(line["confidence_level"] for line in second[next(iter(second))])
    assert highest > max(line["confidence_level"] for line in plain[next(iter(plain))])


def test_priors_and_options_that_do_not_fit_are_refused(
    model, minicity_annotations, tmp_path, capsys
):
    drive, out = str(minicity_annotations["val"]), str(tmp_path / "map.json")
    path = tmp_path / "town.elements"
    infer.main([drive, "--model", *model, "--out", out])
    words = [out, "--ann", drive, "--score-thr", "0", "--prior", str(path)]
    with pytest.raises(ValueError, match="--elements needs one map, and there are 2: --join"):
        build_map.write_element_prior(path, "town", ["divider"], [MapElements.from_polylines()] * 2)
    assert not path.exists()
    build_map.main([*words, "--elements", "--join"])
    again = [drive, "--model", *model, "--out", str(tmp_path / "b.json"), "--prior"]
    with pytest.raises(ValueError, match=r"or set model\.prior\.type=ElementFusion"):
        infer.main([*again, str(path)])
    with pytest.raises(ValueError, match="has elements, which a model can only read"):
        infer.main([*again, str(path), "--update-prior", *FUSION])
    with pytest.raises(ValueError, match="ElementFusion writes to no prior"):
        infer.main([*again, str(tmp_path / "new.elements"), "--update-prior", *FUSION])
    for wrong in (["--elements", "--gaussians"], ["--elements"]):
        kept = words if "--gaussians" in wrong else [*words[:-2], "--out", str(tmp_path / "maps")]
        with pytest.raises(SystemExit):
            build_map.main([*kept, *wrong])
    errors = capsys.readouterr().err
    assert "a prior has --gaussians or --elements" in errors
    assert "--elements is for a --prior" in errors


def test_a_test_counts_the_tested_samples_that_a_prior_was_made_of(tmp_path):
    """Data sets may be joined, and may have a part of the samples of their files."""
    path = tmp_path / "town.prior"
    path.write_bytes(b"prior")
    sources = PriorSources()
    for token in ("a", "b", "c", "d"):
        sources.add(token)
    prior = SimpleNamespace(settings=SimpleNamespace(place="town"), sources=sources)
    joined = SimpleNamespace(
        datasets=[SimpleNamespace(tokens=lambda: ["x", "a"]), SimpleNamespace(tokens=lambda: ["b"])]
    )
    for dataset, count, number in ((joined, 2, 3), (SimpleNamespace(), 0, 0)):
        warnings = []
        evaluator = SimpleNamespace(dataset_meta={"classes": ("divider",)})
        loop = SimpleNamespace(dataloader=SimpleNamespace(dataset=dataset), evaluator=evaluator)
        logger = SimpleNamespace(warning=warnings.append)
        describe_priors(SimpleNamespace(test_loop=loop, logger=logger), [prior], [path])
        (facts,) = evaluator.dataset_meta["priors"]
        assert (facts["made_of"], facts["also_predicted"]) == (4, count)
        assert evaluator.dataset_meta["classes"] == ("divider",)
        assert len(warnings) == bool(count)
        assert not count or f"leak: {count} of {number} samples are among the 4" in warnings[0]
