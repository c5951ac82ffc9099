"""Modules of former releases are found by their former names."""

import sys
from importlib import import_module

import pytest
from mmdet3d.registry import MODELS, TASK_UTILS
from mmengine.config import Config

import gsmap.registered  # noqa: F401
from gsmap.utils.moved import MOVED

# registered classes and what the docs named, by the module of before
NAMED = {
    "attention": ("BEVDeformableAttention", "MultiLevelAttention", "PointSelfAttention"),
    "coder": ("MapCoder", "DetectionHead", "Reference"),
    "decoder": ("MapDecoder", "MapDecoderLayer", "Guidance", "Decoded"),
    "head": ("MapHead", "QueryGroup"),
    "layers": ("mlp", "classification_branch"),
    "losses": ("MapLoss", "PointsLoss", "DirectionLoss"),
    "masks": ("ElementMasks",),
    "matching": ("MapAssigner", "MapCost", "OrderedPointsCost"),
    "pairs": ("GroundTruth", "MatchedPairs", "Predictions", "SampleView"),
    "parts": ("DEFAULTS", "optional_part"),
    "references": ("PointReference",),
}


@pytest.mark.parametrize(("module", "names"), NAMED.items())
def test_a_class_is_found_by_the_name_of_its_former_module(module: str, names: tuple[str, ...]):
    former = import_module(f"gsmap.models.maptr.{module}")
    for name in names:
        found = getattr(former, name)
        for registry in (MODELS, TASK_UTILS):
            assert registry.get(name) in (None, found), name
    assert not hasattr(former, "NoSuchClass")


def test_every_former_module_is_tested_and_has_successors():
    models = {name for name in MOVED if name.startswith("gsmap.models.maptr.")}
    assert {name.rpartition(".")[2] for name in models} <= NAMED.keys()
    for successors in MOVED.values():
        for name in successors:
            assert import_module(name).__spec__.origin.endswith(".py"), name


@pytest.mark.parametrize("name", sorted(set(MOVED) - {f"gsmap.models.maptr.{n}" for n in NAMED}))
def test_a_former_module_of_evaluation_has_the_contents_of_the_one_of_today(name: str):
    (successor,) = MOVED[name]
    former, today = import_module(name), import_module(successor)
    public = [key for key in vars(today) if not key.startswith("__")]
    assert public
    assert all(getattr(former, key) is getattr(today, key) for key in public)


def test_custom_imports_take_a_former_module(tmp_path, monkeypatch):
    monkeypatch.delitem(sys.modules, "gsmap.models.maptr.head", raising=False)
    path = tmp_path / "config.py"
    path.write_text("custom_imports = dict(imports=['gsmap.models.maptr.head'])\n")
    Config.fromfile(path)
    assert sys.modules["gsmap.models.maptr.head"].MapHead is MODELS.get("MapHead")


def test_a_module_that_never_was_is_not_found():
    with pytest.raises(ModuleNotFoundError, match=r"gsmap\.models\.maptr\.heads"):
        import_module("gsmap.models.maptr.heads")
