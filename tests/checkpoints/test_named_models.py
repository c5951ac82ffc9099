"""Models by name: the registry, its files and its errors."""

import hashlib
import re
from pathlib import Path

import pytest
import torch
from mmdet3d.registry import MODELS

from gsmap.apis.map_inferencer import MapInferencer
from gsmap.checkpoints import named_models as registry
from gsmap.checkpoints.named_models import (
    checkpoint_for,
    find_checkpoint,
    find_config,
    list_models,
    named_configs,
    named_models,
)
from gsmap.checkpoints.reading import load_weights
from gsmap.engine.launch import read_config
from gsmap.utils.shipped import shipped_path

REPO = Path(__file__).resolve().parents[2]
SHIPPED = [name for name, model in named_models().items() if model.address is None]


def test_every_model_has_a_config_and_says_where_its_file_is():
    for model in named_models().values():
        assert re.fullmatch(r"\w+", model.name)  # of a file in models/
        assert shipped_path(model.config).is_file(), model.name
        assert model.file.is_file() == (model.address is None), model.name
        assert model.address is None or model.address.startswith("https://")


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_weights_fit_their_config_and_their_digest(name):
    path = find_checkpoint(name)
    assert hashlib.sha256(path.read_bytes()).hexdigest() == named_models()[name].sha256
    assert path.stat().st_size <= 16_000_000
    model = MODELS.build(read_config(name).model)
    load_weights(model, name)
    state = torch.load(path, weights_only=True)["state_dict"]
    key = "map_head.instance_embedding.weight"
    torch.testing.assert_close(model.state_dict()[key], state[key].float())


def test_the_inferencer_takes_a_name_alone():
    inferencer = MapInferencer("maptr_r18_minicity", device="cpu")
    state = torch.load(find_checkpoint("maptr_r18_minicity"), weights_only=True)["state_dict"]
    key = "map_head.instance_embedding.weight"
    torch.testing.assert_close(inferencer.model.state_dict()[key], state[key].float())


def test_a_config_is_found_by_its_path_in_the_repository_from_any_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    config = "configs/maptr/maptr_r18_minicity.py"
    assert find_config(config) == shipped_path(config)
    Path(config).parent.mkdir(parents=True)
    Path(config).touch()
    assert find_config(config) == Path(config)  # one's own comes first


def test_a_config_is_found_by_its_name_from_any_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    name = "gsmap_maptr_r18_minicity"
    assert find_config(name) == shipped_path(f"projects/GSMap/configs/{name}.py")
    assert find_config("maptr_r50_24e") == shipped_path("configs/maptr/maptr_r50_24e.py")
    with pytest.raises(ValueError, match=f"give a checkpoint after {name}: only a model's name"):
        checkpoint_for(name, None)
    with pytest.raises(FileNotFoundError, match=r"config file gsmap.*mean gsmap_maptr_r50_24e\?"):
        find_config("gsmap_maptr_r50_24")
    Path(name).write_text("mine = 1")
    assert find_config(name) == Path(name)


def test_a_name_means_one_config():
    files = [*shipped_path("configs").glob("*.py"), *shipped_path("configs").glob("[!_]*/*.py")]
    files += shipped_path("projects/GSMap/configs").glob("*.py")
    assert sorted(named_configs().values()) == sorted(files)  # so no name stands for two
    for name in named_configs().keys() & named_models():
        assert named_configs()[name] == shipped_path(named_models()[name].config)


def test_a_wrong_name_gets_the_nearest_right_one():
    with pytest.raises(FileNotFoundError, match=r"minicty.*did you mean gsmap_r18_minicity\?"):
        find_config("gsmap_r18_minicty")
    with pytest.raises(FileNotFoundError, match=r"did you mean maptr_r18_minicity\?"):
        find_checkpoint("models/maptr_r18_minicty.pth")
    shipping = {path.stem for path in (REPO / "models").glob("*.pth")}
    with pytest.raises(FileNotFoundError, match=r"x\.pth.*") as caught:
        find_checkpoint("x.pth")
    assert len(shipping) > 3
    assert shipping <= set(re.findall(r"\w+", str(caught.value)))


def test_a_model_that_does_not_ship_says_where_it_is_fetched():
    with pytest.raises(FileNotFoundError, match=r"fetch it from https://.* and save it there"):
        find_checkpoint("maptr_tiny_r50_24e")


def test_a_damaged_file_is_refused(tmp_path, monkeypatch):
    named_models()
    monkeypatch.setattr(registry, "shipped_path", tmp_path.joinpath)
    (tmp_path / "models").mkdir()
    (tmp_path / "models/gsmap_r18_minicity.pth").write_bytes(b"half")
    assert list_models() == ["gsmap_r18_minicity"]
    with pytest.raises(ValueError, match=r"damaged or belongs to another model: its sha256"):
        find_checkpoint("gsmap_r18_minicity")


def test_a_file_of_the_working_folder_does_not_stand_for_a_named_model(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    said = []
    monkeypatch.setattr(registry, "print_log", lambda text, **_: said.append(text))
    for name in ("gsmap_r18_minicity", "maptr_r18_minicity"):
        Path(name).write_bytes(b"somebody's")
        assert find_checkpoint(name) == shipped_path(f"models/{name}.pth")
        assert checkpoint_for(name, None) == shipped_path(f"models/{name}.pth")
        assert find_checkpoint(f"./{name}") == Path(name)
    assert said[0] == (
        "gsmap_r18_minicity refers to the named model; for the file in the working folder write "
        "./gsmap_r18_minicity."
    )


def test_a_file_without_a_known_digest_is_called_unverified_once(tmp_path, monkeypatch):
    named_models()
    registry._warn_unverified.cache_clear()
    monkeypatch.setattr(registry, "shipped_path", tmp_path.joinpath)
    (tmp_path / "models").mkdir()
    said = []
    monkeypatch.setattr(registry, "print_log", lambda text, **_: said.append(text))
    (tmp_path / "models/maptr_tiny_r50_24e.pth").write_bytes(b"whole")
    assert find_checkpoint("maptr_tiny_r50_24e") == find_checkpoint("maptr_tiny_r50_24e")
    digest = hashlib.sha256(b"whole").hexdigest()
    assert said == [
        f"{tmp_path}/models/maptr_tiny_r50_24e.pth is not verified: github.com/hustvl/MapTR gives "
        f"no sha256 for maptr_tiny_r50_24e; the sha256 of this file is {digest}."
    ]


def test_a_config_file_needs_a_checkpoint_and_a_name_does_not():
    config = find_config("gsmap_r18_minicity")
    with pytest.raises(ValueError, match="give a checkpoint after"):
        checkpoint_for(config, None)
    assert checkpoint_for("gsmap_r18_minicity", None).name == "gsmap_r18_minicity.pth"
    assert checkpoint_for(config, "maptr_r18_minicity").name == "maptr_r18_minicity.pth"
