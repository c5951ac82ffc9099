import re
import runpy
import sys
from pathlib import Path

import pytest
import torch
from mmdet3d.registry import MODELS
from mmengine.config import Config
from mmengine.runner.checkpoint import load_checkpoint
from model_cases import (
    build_small,
    make_images,
    make_samples,
    small_config,
    straight_elements,
)
from predictions import stacked
from torch import nn

from gsmap.checkpoints.convert import (
    convert_state,
    ours_from_upstream,
    upstream_from_ours,
)
from gsmap.checkpoints.key_map import key_maps
from gsmap.checkpoints.key_rules import KeyMap
from gsmap.checkpoints.reading import load_weights, read_weights
from gsmap.checkpoints.strict import AddsWeights, adapt_state, neutral_keys
from gsmap.models.gsmap.reference import GaussianReference
from gsmap.models.gsmap.uncertainty import ErrorReference
from gsmap.models.maptr.keys import MAPTR
from gsmap.structures.grid import BEVGrid

REPO = Path(__file__).resolve().parents[2]


def test_a_state_survives_the_way_to_upstream_and_back():
    state = build_small().state_dict()
    upstream, done = convert_state(state)
    assert done == "maptr: gsmap to upstream"
    assert torch.equal(upstream["pts_bbox_head.code_weights"], torch.ones(4))
    back, done = convert_state(upstream)
    wanted = "maptr: upstream to gsmap without 1 key of no use here (pts_bbox_head.code_weights)"
    assert done == wanted
    assert back.keys() == state.keys()
    assert all(torch.equal(back[key], state[key]) for key in state)


def test_unknown_keys_are_named():
    with pytest.raises(ValueError, match=r"no maptr model has: pts_bbox_head\.riddle"):
        ours_from_upstream({"pts_bbox_head.riddle": torch.ones(1)})
    with pytest.raises(ValueError, match=r"upstream's maptr does not have: map_head\.riddle"):
        upstream_from_ours({"map_head.riddle": torch.ones(1)})


def test_an_upstream_file_loads_as_it_is(tmp_path):
    source, target = build_small(seed=1), build_small(seed=2)
    upstream, _ = convert_state(source.state_dict())
    path = tmp_path / "upstream.pth"
    torch.save({"meta": {"epoch": 24}, "state_dict": upstream}, path)
    load_checkpoint(target, str(path))  # what load_from does
    ours, theirs = source.state_dict(), target.state_dict()
    assert all(torch.equal(ours[key], theirs[key]) for key in ours)


def test_gsmap_starts_where_an_upstream_maptr_checkpoint_ended(tmp_path):
    maptr = build_small(seed=1).eval()
    head = {**small_config().map_head, "type": "GSMapHead"}
    gsmap = build_small(seed=2, map_head=head).eval()
    path = tmp_path / "upstream.pth"
    torch.save({"state_dict": upstream_from_ours(maptr.state_dict())}, path)
    load_checkpoint(gsmap, str(path))
    images, samples = make_images(1), make_samples(straight_elements())
    with torch.no_grad():
        expected, outputs = maptr._forward(images, samples), gsmap._forward(images, samples)
    assert torch.equal(stacked(outputs).pts, stacked(expected).pts)
    assert torch.equal(stacked(outputs).scores, stacked(expected).scores)
    with pytest.raises(ValueError, match=r"does not have: .*map_head\.reference\.gaussian_init"):
        upstream_from_ours(gsmap.state_dict())


@pytest.mark.parametrize("upstream", [False, True])
def test_missing_left_over_and_reshaped_keys_are_errors_that_name_them(tmp_path, upstream):
    model = build_small()
    state = dict(model.state_dict())
    state["map_head.cls_branches.0.6.bias"] = torch.zeros(7)
    del state["map_head.reference.initial.bias"]
    state["map_head.cls_branches.9.0.weight"] = torch.zeros(1)
    if upstream:
        state = upstream_from_ours(state)
    path = tmp_path / "wrong.pth"
    torch.save({"state_dict": state}, path)
    with pytest.raises(ValueError, match="does not fit the model") as error:
        load_checkpoint(model, str(path))
    message = str(error.value)
    assert "missing: map_head.reference.initial.bias" in message
    assert "left over: map_head.cls_branches.9.0.weight" in message
    assert "map_head.cls_branches.0.6.bias (7,) instead of (3,)" in message


class Extended(nn.Module, AddsWeights):
    """A model that adds ``extra`` to ``base``."""

    neutral_keys = ("extra.",)

    def __init__(self):
        super().__init__()
        self.base = nn.Linear(2, 2)
        self.extra = nn.Linear(2, 2)


def test_neutral_keys_may_be_missing_together_only():
    model = nn.ModuleDict({"head": Extended()})
    expected = model.state_dict()
    neutral = neutral_keys(model)
    assert neutral == [{"head.extra.weight", "head.extra.bias"}]
    without = {key: value for key, value in expected.items() if "extra" not in key}
    state = dict(without)
    adapt_state(state, expected, "", neutral)
    assert state.keys() == expected.keys()
    assert torch.equal(state["head.extra.weight"], model["head"].extra.weight)
    with pytest.raises(ValueError, match=r"never trained [^!]*: head\.extra\.bias, head\.extra\.w"):
        adapt_state(dict(without), expected, "", neutral, allow_untrained=False)
    adapt_state(dict(without), without, "", [], allow_untrained=False)
    with pytest.raises(ValueError, match=r"missing: head\.extra\.bias\."):
        adapt_state({**without, "head.extra.weight": torch.ones(2, 2)}, expected, "", neutral)


def test_each_part_of_a_model_may_be_missing_alone():
    """As a trained GSMap's lacks memory, but not its Gaussians."""
    model = nn.ModuleDict({"head": Extended(), "temporal": Extended()})
    expected = model.state_dict()
    state = {key: torch.ones_like(value) for key, value in expected.items()}
    for name in ("weight", "bias"):
        del state[f"temporal.extra.{name}"]
    adapt_state(state, expected, "", neutral_keys(model))
    assert torch.equal(state["temporal.extra.weight"], model["temporal"].extra.weight)
    assert torch.equal(state["head.extra.weight"], torch.ones(2, 2))


def test_a_trained_gsmap_may_lack_the_errors_alone():
    """So what learns errors can start from a model that has none, whose Gaussians are kept."""
    grid = BEVGrid((-15, 15), (-30, 30))
    trained, made = (kind(grid, 8, num_layers=2) for kind in (GaussianReference, ErrorReference))
    state = {key: torch.ones_like(value) for key, value in trained.state_dict().items()}
    adapt_state(state, made.state_dict(), "", neutral_keys(made))
    assert state.keys() == made.state_dict().keys()
    assert all((v == 1).all() for k, v in state.items() if not k.startswith("error_branches."))
    del state["gaussian_branches.0.0.bias"]
    with pytest.raises(ValueError, match=r"missing: gaussian_branches\.0\.0\.bias\."):
        adapt_state(state, made.state_dict(), "", neutral_keys(made))


def test_a_file_of_something_else_is_refused(tmp_path):
    path = tmp_path / "other.pth"
    torch.save({"state_dict": {"epoch": 3}}, path)
    with pytest.raises(ValueError, match="holds no state dict of tensors"):
        read_weights(path)


def test_a_training_checkpoint_converts_without_its_auxiliary_heads(tmp_path):
    """The masks that teach MiniCity's small MapTR to see have no place in upstream's."""
    cfg = Config.fromfile(REPO / "configs/maptr/maptr_r18_minicity.py")
    state = read_weights("maptr_r18_minicity")
    assert "map_head.aux_heads.seg.0.weight" in state
    upstream, done = convert_state(state)
    assert "without the 3 weights of auxiliary heads" in done
    torch.save(upstream, tmp_path / "upstream.pth")
    cfg.model.map_head.aux_heads = []
    model = MODELS.build(cfg.model)
    load_weights(model, tmp_path / "upstream.pth")
    assert all(torch.equal(value, state[key]) for key, value in model.state_dict().items())


def test_the_tool_converts_files_and_refuses_to_overwrite(tmp_path, monkeypatch, capsys):
    state = build_small().state_dict()
    source, target = tmp_path / "ours.pth", tmp_path / "upstream.pth"
    torch.save({"state_dict": state}, source)
    monkeypatch.setattr(sys, "argv", ["convert_checkpoint.py", str(source), str(target)])
    tool = str(REPO / "tools/convert_checkpoint.py")
    runpy.run_path(tool, run_name="__main__")
    assert "maptr: gsmap to upstream" in capsys.readouterr().out
    upstream = read_weights(target)
    assert all(torch.equal(upstream[MAPTR.to_upstream(key)], state[key]) for key in state)
    with pytest.raises(SystemExit) as left:
        runpy.run_path(tool, run_name="__main__")
    assert left.value.code == 2
    assert "exists already" in capsys.readouterr().err
    assert sorted(tmp_path.iterdir()) == [source, target]


PAGES = [REPO / "docs/upstream_names.md", *sorted((REPO / "docs/methods/names").glob("*.md"))]


def test_every_unused_key_is_documented():
    text = "\n\n".join(page.read_text() for page in PAGES)
    for key_map in key_maps():
        for key in key_map.unused:
            named = key in text or key.endswith(tuple(_suffixes(text)))
            assert named or key.startswith(tuple(_parts_without_use(text))), key


def _suffixes(text):
    """Return the abbreviated keys of the tables' rows, as ``.norm.bias``."""
    return re.findall(r"`(\.[\w.]+)`", text)


def _parts_without_use(text):
    """Return the parts that tables of keys without counterpart name, as ``bevencode.up.*``."""
    tables = re.findall(
        r"^\| upstream key (?:without counterpart )?\| (?!ours).*?\n\n", text, re.M | re.S
    )
    return re.findall(r"`(\w[\w.]+\.)\*`", "".join(tables))


def groups_of_key_maps():
    """Return the groups of common rows that each key map has, as the pages say them."""
    said = {}
    for page in PAGES:
        for name, words in re.findall(
            r"Checkpoints of `([\w-]+)`: the rows ([^.:]+)", page.read_text()
        ):
            said[name] = set(re.findall(r"\*([^*]+)\*", words))
    return said


def test_the_tables_of_keys_in_the_docs_are_the_tables_of_the_code():
    groups = groups_of_key_maps()
    maps = {key_map.name: key_map for key_map in key_maps() if key_map.name in groups}
    assert maps.keys() == groups.keys()
    common = re.findall(
        r"^\| ([^`|]+) \| `([\w.*]+)` \| (?:`([\w.*]+)`|unchanged) \|$", PAGES[0].read_text(), re.M
    )
    assert len(common) > 20
    assert set().union(*groups.values()) == {group for group, *_ in common}
    shown = {name: set() for name in maps}
    for group, upstream, ours in common:
        for name in maps:
            if group in groups[name]:
                shown[name].add((upstream, ours or upstream))
    for page in PAGES[1:]:
        rows = re.findall(r"^\| `([\w.*]+)` \| `([\w.*]+)` \|$", page.read_text(), re.M)
        for name in re.findall(r"Checkpoints of `([\w-]+)`: the rows", page.read_text()):
            shown[name].update(rows)
    for name, key_map in maps.items():
        for row in shown[name]:
            upstream, ours = (re.sub(r"\bN\b", "3", key).replace("*", "9.weight") for key in row)
            assert key_map.to_ours(upstream) == ours, (name, upstream)
        told = {tuple(key.rstrip("*") for key in row) for row in shown[name]}
        rules = {tuple(part.replace("{i}", "N") for part in rule) for rule in key_map.rules}
        assert rules == told, name


def test_tables_that_need_no_marker_come_after_all_others():
    """They take any keys: those of another method would be MapTR's."""
    unmarked = [key_map.markers == KeyMap.markers for key_map in key_maps()]
    assert unmarked == sorted(unmarked)
    assert any(unmarked)
