import copy
import json
import zipfile

import pytest
import torch
from fuzz.attacks import Calls
from mmdet3d.registry import MODELS
from mmengine.config import Config
from torch import nn

from gsmap.apis.rig_fit import training_facts
from gsmap.checkpoints.named_models import named_models
from gsmap.checkpoints.published import load_from_file
from gsmap.checkpoints.reading import (
    adopt_settings,
    load_weights,
    read_checked,
    read_weights,
)
from gsmap.checkpoints.settings import MODEL_SETTINGS, differences, plain
from gsmap.engine.launch import read_config


def save(path, content):
    torch.save(content, path)
    return path


def test_weights_are_loaded_from_a_training_checkpoint_and_a_bare_state(tmp_path):
    source, target = nn.Linear(2, 3), nn.Linear(2, 3)
    for content in ({"state_dict": source.state_dict(), "meta": {"epoch": 1}}, source.state_dict()):
        load_weights(target, save(tmp_path / "a.pth", content))
        torch.testing.assert_close(target.weight, source.weight)
        nn.init.zeros_(target.weight)


def test_a_checkpoint_says_which_scenes_it_was_trained_on(tmp_path):
    def saved(**said):
        content = {"state_dict": {"x": torch.ones(1)}, "meta": {"dataset_meta": said}}
        return save(tmp_path / "a.pth", content)

    identity = "near@" + "0" * 16
    found = read_checked(saved(dataset="av2", split_list=identity))
    assert found.trained_on == ("av2", identity)
    assert read_checked(saved(dataset="av2")).trained_on == ("av2", "")
    with pytest.raises(ValueError, match=r"a.pth is not .*split_list must be a name with a digest"):
        read_checked(saved(dataset="av2", split_list=["near"]))


def test_weights_that_several_processes_trained_lose_their_prefix(tmp_path):
    state = {"module.weight": torch.ones(1), "head.module.bias": torch.zeros(1)}
    assert list(read_weights(save(tmp_path / "a.pth", state))) == ["weight", "head.module.bias"]


def test_other_architecture_lists_the_first_keys_and_the_remedy(tmp_path):
    path = save(tmp_path / "other.pth", nn.Sequential(nn.Linear(2, 3)).state_dict())
    message = r"other.pth does not belong .*lacks weight, bias and has 0.weight, 0.bias too many"
    with pytest.raises(ValueError, match=message):
        load_weights(nn.Linear(2, 3), path)
    with pytest.raises(ValueError, match=r"and 5 more"):
        load_weights(
            nn.Sequential(*[nn.Linear(2, 2) for _ in range(4)]), save(path, {"x": torch.ones(1)})
        )


def test_other_size_is_named(tmp_path):
    path = save(tmp_path / "wide.pth", nn.Linear(4, 3).state_dict())
    with pytest.raises(ValueError, match=r"wide.pth does not belong [^!]*size mismatch for weight"):
        load_weights(nn.Linear(2, 3), path)


def test_checkpoint_that_would_run_code_is_refused_and_nothing_runs(tmp_path):
    path = save(
        tmp_path / "attack.pth",
        {"state_dict": {"w": torch.ones(1)}, "x": Calls(open, str(tmp_path / "proof"), "w")},
    )
    message = r"attack.pth was not loaded: .*save its state_dict alone and give that file\.$"
    with pytest.raises(ValueError, match=message):
        read_weights(path)
    assert not (tmp_path / "proof").exists()


def test_missing_truncated_and_empty_files_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no checkpoint .*gone.pth"):
        read_weights(tmp_path / "gone.pth")
    path = save(tmp_path / "half.pth", {"w": torch.ones(1000)})
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(ValueError, match=r"half.pth"):
        read_weights(path)
    path.write_bytes(b"")
    with pytest.raises(ValueError, match=r"half.pth"):
        read_weights(path)
    with pytest.raises(ValueError, match=r"holds no state dict"):
        read_weights(save(tmp_path / "meta.pth", {"meta": {}}))


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_weights_that_are_not_finite_are_refused(tmp_path, value):
    state = {"good": torch.ones(2), "bad": torch.tensor([1.0, value]), "count": torch.tensor(3)}
    with pytest.raises(ValueError, match=r"failed.pth holds NaN or infinite weights \(bad\)"):
        read_weights(save(tmp_path / "failed.pth", {"state_dict": state}))


@pytest.mark.parametrize(
    "content",
    [
        {1: torch.ones(2)},
        {"state_dict": [torch.ones(2)]},
        {"a": torch.eye(3).to_sparse()},
        {"a": torch.ones(3, device="meta")},
        {"a": torch.quantize_per_tensor(torch.ones(3), 1.0, 0, torch.qint8)},
        {"a": torch.ones(3).to(torch.float8_e4m3fn)},
        {"a": torch.ones(1).expand(2**48)},
        {"state_dict": {"a": torch.ones(2)}, "meta": ["epoch"]},
    ],
    ids=["number", "list", "sparse", "meta", "quantised", "float8", "huge", "meta is a list"],
)
def test_what_is_no_plain_state_dict_is_refused_in_words(content, tmp_path):
    with pytest.raises(ValueError, match=r"odd.pth (holds no state|is not a whole|repeats)"):
        read_weights(save(tmp_path / "odd.pth", content))


@pytest.fixture
def small() -> Config:
    """The config of a small model."""
    return read_config("configs/maptr/maptr_r18_minicity.py")


def test_test_data_are_as_those_that_the_checkpoint_was_trained_on(small, tmp_path):
    def steps():
        return [small[f"{part}_dataloader"].dataset.pipeline[1] for part in ("test", "train")]

    path = save(tmp_path / "a.pth", {"state_dict": {"w": torch.ones(1)}})
    adopt_settings(small, path, None)
    assert "trained_size" not in steps()[0]
    assert "signals_from_poses" not in small.test_dataloader.dataset
    for options in ({"image_scale": 0.5}, {"test_dataloader.dataset.pipeline.1.scale": 0.5}):
        adopt_settings(small, "maptr_r18_minicity", options)
        assert "trained_size" not in steps()[0]  # asked for by hand
    adopt_settings(small, "maptr_r18_minicity", {"model.grid": None})
    assert steps() == [
        {"type": "ScaleImages", "scale": 0.4, "trained_size": (160, 90)},
        {"type": "ScaleImages", "scale": 0.4},
    ]
    save(path, {"state_dict": {"w": torch.ones(1)}, "meta": {"image_size": [320, 180]}})
    adopt_settings(small, path, None)
    assert steps()[0].trained_size == (320, 180)
    assert small.test_dataloader.dataset.signals_from_poses is True  # the named model's were given


def test_a_shipped_checkpoint_is_known_by_any_path(monkeypatch, tmp_path):
    file = named_models()["maptr_r18_minicity"].file
    (tmp_path / "link.pth").symlink_to(file)
    monkeypatch.chdir(file.parent)
    for path in (file, file.name, f"../{file.parent.name}/{file.name}", tmp_path / "link.pth"):
        checkpoint = read_checked(path)
        assert (checkpoint.image_size, checkpoint.can_bus) == ((160, 90), True)
        facts = training_facts(path, dataset_meta=None)
        assert facts["cameras"][0] == "CAM_FRONT"
    assert training_facts(tmp_path / "other.pth", dataset_meta=None) == {}


def test_test_data_have_no_signals_if_the_training_had_none(tmp_path):
    without = {"can_bus": False}
    for meta, wanted in ((without, True), ({"can_bus": True}, None), ({}, None)):
        path = save(tmp_path / "a.pth", {"state_dict": {"w": torch.ones(1)}, "meta": meta})
        cfg = read_config("configs/maptr/maptr_r18_minicity.py")
        adopt_settings(cfg, path, None)
        assert cfg.test_dataloader.dataset.get("zero_signals") is wanted
    for name in ("signals_from_poses", "pose_only_signals"):  # the config asks for signals
        path = save(tmp_path / "a.pth", {"state_dict": {"w": torch.ones(1)}, "meta": without})
        cfg = read_config("configs/maptr/maptr_r18_minicity.py")
        cfg.test_dataloader.dataset[name] = True
        adopt_settings(cfg, path, None)
        assert "zero_signals" not in cfg.test_dataloader.dataset
    cfg.test_dataloader.dataset = {"type": "mmengine.BaseDataset"}  # has no such argument
    adopt_settings(cfg, path, None)
    assert cfg.test_dataloader.dataset == {"type": "mmengine.BaseDataset"}
    cfg.test_dataloader.dataset.zero_signals = False  # asked for by hand
    adopt_settings(cfg, save(tmp_path / "a.pth", {"state_dict": {"w": torch.ones(1)}}), None)
    assert cfg.test_dataloader.dataset.zero_signals is False


@pytest.mark.parametrize("size", [3, [3], ["a", "b"], [0, 5], [1, 10**9], [1.5, 2], [1, 2, 3]])
def test_an_image_size_that_is_none_is_refused(size, tmp_path):
    content = {"state_dict": {"w": torch.ones(1)}, "meta": {"image_size": size}}
    with pytest.raises(ValueError, match=r"a\.pth is not a whole checkpoint \(TypeError"):
        read_weights(save(tmp_path / "a.pth", content))


def test_parts_that_were_never_trained_are_used_only_where_that_is_asked_for(small, tmp_path):
    small.model.map_head.type = "GSMapHead"
    settings = plain(small.model.to_dict()) | {"allow_untrained": True}
    settings["map_head"]["losses"] = []
    path = with_settings(tmp_path / "a.pth", settings)
    adopt_settings(small, path, None)
    assert small.model.allow_untrained is False  # not for the file to say
    with pytest.raises(ValueError, match="was never trained with parts"):
        load_weights(MODELS.build(small.model), "maptr_r18_minicity")
    small.model.allow_untrained = True
    small.model.map_head.losses = [{"type": "PointsLoss"}]
    adopt_settings(small, path, None)
    load_weights(MODELS.build(small.model), "maptr_r18_minicity")


def with_settings(path, settings):
    meta = {MODEL_SETTINGS: json.dumps(settings)}
    return save(path, {"state_dict": {"w": torch.ones(1)}, "meta": meta})


def test_a_model_is_tested_with_the_settings_of_its_checkpoint(small, tmp_path):
    settings = plain(small.model.to_dict())
    path = with_settings(tmp_path / "a.pth", settings)
    before = small.model
    assert adopt_settings(small, path, {"data.size": 3}) == []
    assert small.model is before
    settings["map_head"]["losses"][0]["loss_weight"] = 3.0
    settings["map_head"]["losses"].append({"type": "EuclideanLoss"})
    settings["img_backbone"]["init_cfg"] = {"type": "Pretrained", "checkpoint": "x/y.pth"}
    path = with_settings(tmp_path / "a.pth", settings)
    of_losses = "model.map_head.losses"
    trained = [
        f"{of_losses}.0.loss_weight: 3.0, as {path} was trained; the config has 5.0",
        f"{of_losses}.2: {{'type': 'EuclideanLoss'}}, as {path} was trained; the config has None",
    ]
    assert adopt_settings(small, path, None) == trained
    del settings["img_backbone"]["init_cfg"]  # how weights start: the checkpoint has all of them
    del settings["bev_encoder"]["uniform_positions"]
    del settings["bev_encoder"]["cross_attn"]["equal_weights"]
    assert small.model.to_dict() == {**settings, "allow_untrained": False}
    options = {f"{of_losses}.0.loss_weight": 5.0, "model.img_backbone.init_cfg": None}
    small.merge_from_dict(options)
    assert adopt_settings(small, path, options) == [
        f"{of_losses}.0.loss_weight: 5.0, as asked for; {path} was trained with 3.0"
    ]
    assert small.model.map_head.losses[0].loss_weight == 5.0
    assert adopt_settings(small, save(path, {"w": torch.ones(1)}), None) == []


def test_the_memory_of_elements_is_the_configs_for_it_is_not_trained(small, tmp_path):
    small.model.map_head.type = "GSMapHead"
    trained = plain(small.model.to_dict())
    path = with_settings(tmp_path / "a.pth", trained)
    small.model.temporal = {"elements": {"gate_m": 2.0}}
    assert adopt_settings(small, path, None) == []
    assert small.model.temporal == {"elements": {"gate_m": 2.0}}
    small.model.temporal = None
    with_settings(path, {**trained, "temporal": {"elements": {}}})
    assert adopt_settings(small, path, None) == []
    assert small.model.temporal is None
    with_settings(path, {**trained, "temporal": {"bev": {}, "embed_dims": 16, "elements": {}}})
    small.model.temporal = {"elements": {"gate_m": 2.0}}
    adopt_settings(small, path, None)
    assert small.model.temporal == {"bev": {}, "embed_dims": 16, "elements": {"gate_m": 2.0}}


@pytest.mark.parametrize(
    ("part", "value", "message"),
    [
        ("img_backbone", {"type": "mmdet.SwinTransformer"}, "img_backbone.type is 'mmdet.Swin"),
        ("map_head", {"type": "MapHead", "num": 1}, "missing 4 required .* 'decoder'"),
        ("map_head", None, "'NoneType' object is not a mapping"),
        ("bev_encoder", {"type": "BEVQueryEncoder"}, "missing 1 required .* 'cross_attn'"),
    ],
)
def test_settings_that_make_no_model_are_the_checkpoints_fault(
    part, value, message, small, tmp_path
):
    settings = {**plain(small.model.to_dict()), part: value}
    path = with_settings(tmp_path / "a.pth", settings)
    with pytest.raises(ValueError, match=message) as raised:
        adopt_settings(small, path, None)
    text = str(raised.value)
    assert text.startswith(f"{path} was not loaded, because its model settings are refused: ")
    assert "maptr_r18_minicity.py" not in text


def test_a_part_of_the_config_may_be_set_otherwise(small, tmp_path):
    """A part that others register is built from a checkpoint where the config has it too."""
    settings = plain(small.model.to_dict())
    settings["img_backbone"] |= {"style": "caffe", "norm_cfg": {"type": "BN2d"}}
    path = with_settings(tmp_path / "a.pth", settings)
    lines = adopt_settings(small, path, None)
    assert [line.split(":")[0] for line in lines] == [
        "model.img_backbone.norm_cfg.type",
        "model.img_backbone.norm_cfg.requires_grad",
        "model.img_backbone.style",
    ]
    assert small.model.img_backbone.style == "caffe"


def test_differences_of_other_kinds_are_named_whole():
    assert differences({"a": [1]}, {"a": {"b": 1}}) == {"a": ([1], {"b": 1})}
    assert differences({"a": None}, {"a": {"b": 1}}) == {"a": (None, {"b": 1})}
    assert differences([1, 2], [1, 2, 3], "x") == {"x.2": (None, 3)}


def test_a_checkpoint_with_packed_parts_is_refused(tmp_path):
    """Zeros of 2 GB are 2 MB packed; torch packs nothing."""
    plain_file = save(tmp_path / "a.pth", {"state_dict": {"x": torch.ones(1)}})
    assert read_checked(plain_file).state["x"] == 1
    packed = tmp_path / "b.pth"
    with (
        zipfile.ZipFile(plain_file) as source,
        zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as target,
    ):
        for name in source.namelist():
            target.writestr(name, source.read(name))
    with pytest.raises(ValueError, match=r"b.pth .*is compressed, which torch never does"):
        read_checked(packed)
    with pytest.raises(ValueError, match=r"b.pth .*is compressed, which torch never does"):
        load_from_file(str(packed))


def test_a_checkpoint_whose_parts_overlap_is_refused(tmp_path):
    """Many names for one part stand for any number of weights."""
    whole = save(tmp_path / "a.pth", {"state_dict": {"x": torch.ones(10_000), "y": torch.ones(1)}})
    overlapping = tmp_path / "b.pth"
    with (
        zipfile.ZipFile(whole) as source,
        zipfile.ZipFile(overlapping, "w") as target,
    ):
        for name in source.namelist():
            target.writestr(name, source.read(name))
        part = next(info for info in target.filelist if info.filename.endswith("data/0"))
        for number in range(2, 5):
            other = copy.copy(part)
            other.filename = part.filename.replace("data/0", f"data/{number}")
            target.filelist.append(other)
    with pytest.raises(ValueError, match=r"b.pth is not a whole .*its parts overlap"):
        read_checked(overlapping)


def test_weights_that_repeat_few_values_are_refused_before_they_fill_the_memory(tmp_path):
    one = torch.ones(1)
    huge = save(tmp_path / "a.pth", {"state_dict": {"x": one.expand(10**9)}})
    with pytest.raises(ValueError, match=r"a.pth repeats 4 bytes of weights until they are 4"):
        read_checked(huge)
    many = {f"x{number}": one.expand(10**6) for number in range(100)}
    with pytest.raises(ValueError, match=r"b.pth repeats 4 bytes"):
        read_checked(save(tmp_path / "b.pth", {"state_dict": many}))
    tied = {"x": one.expand(7), "y": one}
    assert read_checked(save(tmp_path / "c.pth", {"state_dict": tied})).state["x"].shape == (7,)
