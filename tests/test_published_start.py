"""Published configs start: their weights are found without a network, and reach the backbone.

Every command that README and docs give for a published config is started by the tool's own main
function up to its first iteration, in this process, on MiniCity in nuScenes format. The weights are
random and lie under their published names, in their publishers' formats.
"""

import functools
import runpy
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from comparison.plan import parse_entry
from mmdet3d.registry import MODELS
from mmengine.config import Config
from mmengine.registry import DefaultScope
from mmengine.runner import CheckpointLoader
from mmengine.runner import checkpoint as mmengine_checkpoint
from released_settings import rates_of, released
from test_configs import LEAVES, REPO, annotations, load, on_minicity, shrink_images  # noqa: F401
from test_docs_commands import PAGES, commands
from unset_weights import unset_weights

import gsmap.engine.launch
from gsmap.checkpoints.efficientnet_keys import efficientnet_rules
from gsmap.checkpoints.key_rules import KeyMap
from gsmap.checkpoints.published import WEIGHTS
from gsmap.engine.run_log import MapRunner

PUBLISHED = ("maptr_r18_24e.py", "gemap_full_v299_110e.py", "gemap_full_swint_110e.py")
OWN_DATA = ("minicity", "overfit", "rendered", "my_")


class Reached(Exception):
    """A training is at its first iteration."""


def in_docs() -> Iterator[list[str]]:
    """Yield the words after ``python`` of each training of a published config in the pages."""
    for page in PAGES:
        for program, *words in commands(page):
            if program.startswith("tools/dist_train"):
                yield ["tools/train.py", words[0], *words[2:]]
            elif words[:1] == ["tools/train.py"]:
                yield words
            elif words[:1] == ["tools/compare.py"] and "--list" not in words:
                entries = [word for word in words[1:] if ".py" in word]
                for entry in map(parse_entry, entries):
                    options = ["--cfg-options", *entry.options] if entry.options else []
                    yield ["tools/train.py", str(entry.config), *options]


def published(words: list[str]) -> bool:
    """Whether a command names a config that ships, of nuScenes or Argoverse 2."""
    return (REPO / words[1]).is_file() and not any(part in words[1] for part in OWN_DATA)


@functools.cache
def published_commands() -> list[list[str]]:
    """Return each command once, and a config of every further backbone."""
    found = {tuple(words): words for words in in_docs() if published(words)}
    extra = [path for path in LEAVES if path.name in PUBLISHED]
    return [*found.values(), *(["tools/train.py", str(path.relative_to(REPO))] for path in extra)]


def as_published(backbone: dict[str, Any], state: dict[str, torch.Tensor]) -> dict[str, Any]:
    """Return a backbone's weights in the names that their publisher gives them."""
    if backbone["type"] == "mmdet.EfficientNet":
        keys = KeyMap("efficientnet", efficientnet_rules("", ""))
        return {str(keys.to_upstream(key)): value for key, value in state.items()}
    if backbone["type"] == "VoVNet":
        return {"model": {f"backbone.bottom_up.{key}": value for key, value in state.items()}}
    if backbone["type"] == "mmdet.SwinTransformer":
        return swin_state(backbone["init_cfg"]["checkpoint"], state)
    return {**state, "fc.weight": torch.zeros(1000, 2048), "fc.bias": torch.zeros(1000)}


def swin_state(address: str, state: dict[str, torch.Tensor]) -> dict[str, Any]:
    """Return the weights of a Swin Transformer in its authors' names and wrapping."""
    names = (
        ("stages.", "layers."), ("attn.w_msa.", "attn."), ("ffn.layers.0.0.", "mlp.fc1."),
        ("ffn.layers.1.", "mlp.fc2."), ("patch_embed.projection", "patch_embed.proj"),
    )  # fmt: skip
    theirs = {}
    for key, value in state.items():
        if "downsample." in key:  # four neighbours: column by column there, interleaved in mmdet
            parts = value.reshape(-1, value.shape[-1] // 4, 4).transpose(1, 2)
            value = parts[:, [0, 2, 1, 3]].reshape(value.shape)
        for ours, upstream in names:
            key = key.replace(ours, upstream)
        theirs[key] = value
    if "upernet" not in address:
        return {"model": theirs}
    return {"state_dict": {f"backbone.{key}": value for key, value in theirs.items()}}


def zero_model(cfg: Config) -> torch.nn.Module:
    """Build a config's model with all of its parameters at zero."""
    model = MODELS.build(cfg.model)
    for parameter in model.parameters():
        parameter.data.zero_()
    return model


class Weights:
    """A folder of random weights under their published names, made when a config wants them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.states: dict[str, dict[str, torch.Tensor]] = {}
        self.kinds: dict[str, dict[str, Any]] = {}  # settings of the backbone of each state

    def of(self, cfg: Config) -> dict[str, torch.Tensor]:
        """Return the weights of a config's image backbone, in our names."""
        backbone = cfg.model.img_backbone.to_dict()
        address = backbone["init_cfg"]["checkpoint"]
        kind = {key: value for key, value in backbone.items() if key != "init_cfg"}
        if self.kinds.get(address) != kind:  # such as one of other stages
            torch.manual_seed(0)
            with unset_weights():
                state = MODELS.build({**backbone, "init_cfg": None}).state_dict()
            state = {
                key: torch.rand_like(value).mul_(0.1) if value.is_floating_point() else value
                for key, value in state.items()
                if "offset" not in key  # of deformable convolutions, which nobody publishes
            }
            self.states[address], self.kinds[address] = state, kind
            torch.save(as_published(backbone, state), self.folder / Path(address).name)
        return self.states[address]


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> Weights:
    return Weights(tmp_path_factory.mktemp("weights"))


@pytest.fixture
def mmengine_as_before() -> Iterator[None]:
    """Undo what a run changes of mmengine and torch."""
    schemes, load_url = dict(CheckpointLoader._schemes), mmengine_checkpoint.load_url
    allowed = torch.serialization.get_safe_globals()
    yield
    CheckpointLoader._schemes = schemes
    mmengine_checkpoint.load_url = load_url
    torch.serialization.clear_safe_globals()
    torch.serialization.add_safe_globals(allowed)
    DefaultScope._instance_dict.clear()


def make_tiny(cfg: Config, root: Path, annotations: Callable) -> None:  # noqa: F811
    """Let a published config train on MiniCity, sample by sample, with small images."""
    if "num_cams" in (cfg.model.get("bev_encoder") or {}):
        cfg.model.bev_encoder.num_cams = 6
    if cfg.model.get("prior"):
        cfg.model.prior.bev.layer.num_cams = 6
    shrink_images(cfg)
    for part in ("train", "val", "test"):
        loader = cfg[f"{part}_dataloader"]
        on_minicity(loader.dataset, root, annotations)
        loader.update(num_workers=0, persistent_workers=False, batch_size=1)
    if "slots" in cfg.train_dataloader.sampler:
        cfg.train_dataloader.sampler.slots = 1


@pytest.mark.usefixtures("mmengine_as_before")
@pytest.mark.parametrize("words", published_commands(), ids=lambda words: " ".join(words[1:])[:90])
def test_a_command_of_the_pages_reaches_its_first_iteration(
    words, minicity_root, annotations, weights, monkeypatch, tmp_path  # noqa: F811
):  # fmt: skip
    at_first: list[MapRunner] = []

    def call_hook(runner: MapRunner, name: str, **kwargs: Any) -> None:
        if name == "before_train_iter":
            at_first.append(runner)
            raise Reached
        super(MapRunner, runner).call_hook(name, **kwargs)

    original = gsmap.engine.launch.load_config

    def load_tiny(args: Any) -> Config:
        cfg = original(args)
        make_tiny(cfg, minicity_root, annotations)
        weights.of(cfg)
        monkeypatch.setenv(WEIGHTS, str(weights.folder))
        if cfg.load_from:
            cfg.load_from = str(tmp_path / cfg.load_from)
            torch.save(zero_model(cfg).state_dict(), cfg.load_from)
        return cfg

    monkeypatch.chdir(REPO)
    monkeypatch.setattr(MapRunner, "call_hook", call_hook)
    monkeypatch.setattr(gsmap.engine.launch, "load_config", load_tiny)
    monkeypatch.setattr(sys, "argv", [*words, "--work-dir", str(tmp_path / "run")])
    monkeypatch.setitem(sys.modules, "torchvision", None)
    main = runpy.run_path(str(REPO / words[0]), run_name="tool")["main"]
    with unset_weights(), pytest.raises(Reached):  # those that it loads have values
        main()
    (runner,) = at_first
    if words[1] in released() and len(words) == 2:
        rates = released()[words[1]].rates
        groups = runner.optim_wrapper.optimizer.param_groups
        assert rates_of(runner.model, groups, tuple(rates)) == pytest.approx(rates)
    if runner.cfg.load_from:
        return  # what it loads takes the place of the backbone's weights
    start = runner.model.img_backbone.state_dict()
    for key, value in weights.of(runner.cfg).items():
        torch.testing.assert_close(start[key], value, msg=key)
