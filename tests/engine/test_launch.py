import argparse
import os
import re
from pathlib import Path

import pytest
import torch
from mmengine.config import Config
from paper_cases import require_target

from gsmap.datasets.transforms.map_targets import FormatMapTargets
from gsmap.engine.arguments import add_common_arguments
from gsmap.engine.launch import (
    check_config,
    load_config,
    newest_checkpoint,
    read_config,
)

SPLITS = ("train", "val", "test")


def parse(*arguments):
    parser = argparse.ArgumentParser()
    parser.add_argument("config")
    add_common_arguments(parser)
    return parser.parse_args(arguments)


def test_options_override_and_the_work_folder_takes_the_config_name(tmp_path):
    path = tmp_path / "tiny.py"
    path.write_text("_four = 4\ntrain_dataloader = dict(batch_size=_four)\n")
    cfg = load_config(parse(str(path), "--cfg-options", "train_dataloader.batch_size=1"))
    assert cfg.train_dataloader.batch_size == 1
    assert "_four" not in cfg  # nor in what a run writes
    assert cfg.work_dir == "work_dirs/tiny"
    assert load_config(parse(str(path), "--work-dir", "elsewhere")).work_dir == "elsewhere"


@pytest.mark.parametrize("swapped", [False, True])
def test_one_folder_serves_every_split_unless_an_override_says_otherwise(swapped):
    here, there = "--cfg-options val_dataloader.dataset.data_root=here", "--data-root there"
    words = f"{there} {here}" if swapped else f"{here} {there}"
    args = parse("maptr_r18_minicity", *words.split())
    cfg = load_config(args)
    roots = [cfg[f"{split}_dataloader"].dataset.data_root for split in SPLITS]
    assert roots == ["there", "here", "there"]
    assert args.data_root == Path("there")


def test_the_last_of_two_data_roots_and_image_scales_counts():
    words = ["--data-root", "first", "--cfg-options", "val_dataloader.dataset.data_root=other"]
    words += ["--image-scale", "0.25", "--data-root", "last", "--image-scale", "0.5"]
    args = parse("maptr_r18_minicity", *words)
    assert args.data_root == Path("last")
    assert args.cfg_options["image_scale"] == 0.5
    cfg = load_config(args)
    roots = [cfg[f"{split}_dataloader"].dataset.data_root for split in SPLITS]
    assert roots == ["last", "other", "last"]


@pytest.mark.parametrize(
    ("option", "instead"),
    [
        ("_cameras=[a]", "give train.dataset.cameras, val.dataset.cameras, test.dataset.cameras,"),
        ("_scale=0.5", "give train.dataset.pipeline.1.scale, val.dataset.pipeline.1.scale, "),
        ("grid.x_range=[-9,9]", "give train.dataset.grid.x_range, val.dataset.grid.x_range, "),
        ("grid.x_range.0=-9", "edit CONFIG"),
        (
            "classes=[a]",
            "give train.dataset.classes, val.dataset.classes, test.dataset.classes, mod",
        ),
        ("_load=[]", "edit CONFIG"),
        ("_nothing=3", "edit CONFIG"),
        ("vis_backends=[]", "give visualizer.vis_backends, or edit CONFIG"),
    ],
)
def test_an_override_of_a_value_that_was_copied_is_refused_with_its_copies(option, instead):
    with pytest.raises(ValueError, match="changes nothing: the other settings have cop") as refused:
        load_config(parse("configs/my_data.py", "--cfg-options", option))
    said = str(refused.value).replace("_dataloader", "")
    assert f"Instead {instead}" in re.sub(r"\S*my_data\.py", "CONFIG", said)


def test_one_scale_serves_the_images_of_every_split():
    cfg = load_config(parse("configs/my_data.py", "--image-scale", "0.125"))
    scales = [cfg[f"{split}_dataloader"].dataset.pipeline[1].scale for split in SPLITS]
    assert scales == [0.125] * 3
    with pytest.raises(ValueError, match=r"--image-scale: no pipeline of .* has ScaleImages"):
        read_config(Config({"test_dataloader": {"dataset": {}}}), {"image_scale": 0.5})


def test_one_folder_and_one_scale_serve_wrapped_data_sets():
    cfg = read_config("configs/my_data.py").to_dict()
    plain = cfg["train_dataloader"]["dataset"]
    repeated = {"type": "RepeatDataset", "times": 2, "dataset": plain}
    cfg["train_dataloader"]["dataset"] = {"type": "ConcatDataset", "datasets": [repeated, plain]}
    cfg["images_on_device"] = True
    wrapper = read_config(Config(cfg), {"data_root": "here", "image_scale": 0.25})
    first, second = wrapper.train_dataloader.dataset.datasets
    for dataset in (first.dataset, second):
        assert dataset.data_root == "here"
        assert dataset.pipeline[0].on_device
        assert dataset.pipeline[1].scale == 0.25
    assert "data_root" not in wrapper.train_dataloader.dataset


@pytest.mark.parametrize("absent", [["val"], ["test"], ["val", "test"], ["train", "val"]])
@pytest.mark.parametrize("value", ["None", "missing"])
def test_one_folder_serves_the_splits_that_there_are(absent, value):
    cfg = read_config("configs/my_data.py").to_dict()
    for split in absent:
        cfg[f"{split}_dataloader"] = None
        if value == "missing":
            del cfg[f"{split}_dataloader"]
    read = read_config(Config(cfg), {"data_root": "here"})
    for split in SPLITS:
        loader = read.get(f"{split}_dataloader")
        assert loader is None if split in absent else loader.dataset.data_root == "here"


def test_a_folder_for_no_data_set_is_refused():
    with pytest.raises(ValueError, match=r"--data-root: .* has no data set"):
        read_config(Config({"val_dataloader": None}), {"data_root": "here"})


def test_a_missing_config_is_named():
    with pytest.raises(FileNotFoundError, match=r"no config file nowhere\.py, and no model"):
        load_config(parse("nowhere.py"))


def test_a_misspelt_key_is_refused_with_the_right_one():
    with pytest.raises(ValueError, match=r"'optim_wraper'; did you mean 'optim_wrapper'\?"):
        read_config(Config({"optim_wraper": {}}))


def test_a_section_that_is_none_is_refused(tmp_path):
    (tmp_path / "a.py").write_text("test_dataloader = ['a']\n")
    with pytest.raises(ValueError, match=r"a\.py: test_dataloader must be dict\(\.\.\.\), got"):
        read_config(tmp_path / "a.py")


def test_a_checkpoint_to_resume_from_is_no_value_of_resume():
    for value in (True, None):
        read_config(Config({"resume": value}))
    with pytest.raises(ValueError, match=r"resume must be True .*, got 'a\.pth'; .*load_from"):
        read_config(Config({"resume": "a.pth"}))


def test_own_values_start_with_an_underscore():
    read_config(Config({"_num_points": 20}))
    with pytest.raises(ValueError, match="start with '_'"):
        read_config(Config({"zzz": 20}))


@pytest.mark.parametrize(
    ("option", "split"),
    [
        ({"model.grid.x_range": [-10.0, 20.0]}, "train"),
        ({"model.grid.y_range": [-30.0, 60.0]}, "train"),
        ({"model.classes": ["ped_crossing", "divider", "boundary"]}, "train"),
        ({"model.classes": ["a", "b", "c", "d"]}, "train"),
        ({"train_dataloader.dataset.classes": ["divider"]}, "train"),
        ({"val_dataloader.dataset.grid.x_range": [-15.0, 15.5]}, "val"),
        ({"test_dataloader.dataset.classes": ["divider"]}, "test"),
    ],
)
def test_a_model_for_another_map_than_its_data_is_refused(option, split):
    cfg = read_config("maptr_r18_minicity", option)
    (name,) = option
    setting = name.removeprefix("model.").partition("dataset.")[2] or name.removeprefix("model.")
    message = (
        rf"model\.{setting} is \[.*\], but {split}_dataloader\.dataset\.{setting} is \[.*: set"
    )
    with pytest.raises(ValueError, match=message):
        check_config(cfg)
    if split == "test" or name.startswith("model."):
        with pytest.raises(ValueError, match=rf"but test_dataloader\.dataset\.{setting} is"):
            check_config(cfg, for_training=False)
    else:  # a test reads no other data set
        check_config(cfg, for_training=False)


def test_equal_maps_may_be_written_in_several_ways_or_left_to_the_annotation_file():
    options = {
        "model.grid.x_range": (-15, 15),
        "model.classes": ("divider", "ped_crossing", "boundary"),
        "val_dataloader.dataset.classes": None,
        "test_dataloader.dataset.grid": None,
    }
    check_config(read_config("maptr_r18_minicity", options))


def test_maps_of_wrapped_data_sets_are_compared_too():
    cfg = read_config("maptr_r18_minicity")
    plain = cfg.train_dataloader.dataset.to_dict()
    other = {"type": "RepeatDataset", "times": 2, "dataset": {**plain, "classes": ["divider"]}}
    cfg.train_dataloader.dataset = {"type": "ConcatDataset", "datasets": [plain, plain]}
    check_config(cfg)
    cfg.train_dataloader.dataset = {"type": "ConcatDataset", "datasets": [plain, other]}
    with pytest.raises(
        ValueError, match=r"train_dataloader\.dataset\.datasets\.1\.dataset\.classes"
    ):
        check_config(cfg)


def test_a_pipeline_without_a_target_of_a_head_is_refused():
    require_target("configs/maptr/maptr_r18_minicity.py", "FormatMapTargets", "MapHead")


def test_targets_are_found_in_wrapped_data_sets_and_steps_and_by_their_base_class():
    class Own(FormatMapTargets):
        pass

    cfg = read_config("configs/maptr/maptr_r50_24e.py")
    plain = cfg.train_dataloader.dataset.to_dict()
    bare = {**plain, "pipeline": [s for s in plain["pipeline"] if s["type"] != "FormatMapTargets"]}
    repeated = {"type": "RepeatDataset", "times": 2, "dataset": plain}
    inner = {"type": "RandomApply", "transforms": [{"type": Own}]}
    own = {**plain, "pipeline": [inner]}
    cfg.train_dataloader.dataset = {"type": "ConcatDataset", "datasets": [repeated, own]}
    check_config(cfg)
    cfg.train_dataloader.dataset = {"type": "ConcatDataset", "datasets": [repeated, bare]}
    with pytest.raises(ValueError, match="MapHead needs the targets of FormatMapTargets"):
        check_config(cfg)


STREAMS = {"type": "StreamTrainSampler", "slots": 2}
WITH_MEMORY = {
    "model": {"temporal": {"bev": {}}},
    "train_dataloader": {"batch_size": 2, "sampler": STREAMS},
    "test_dataloader": {"batch_size": 1, "sampler": {"type": "StreamTestSampler"}},
}


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        (
            {"test_dataloader": {"sampler": {"type": "DefaultSampler"}}},
            r"test_dataloader\.sampler is 'DefaultSampler', .*several ranks, .* to 'StreamTest",
        ),
        ({"val_dataloader": {"batch_size": 1}}, r"val_dataloader\.sampler is None"),
        (
            {"train_dataloader": {"sampler": {"type": "DefaultSampler"}}},
            r"train_dataloader\.sampler .* to 'StreamTrainSampler', or model\.temporal=",
        ),
        (
            {"train_dataloader": {"batch_size": 4, "sampler": STREAMS}},
            r"batch_size is 4 and sampler\.slots is 2: .* set both",
        ),
    ],
)
def test_loaders_that_tear_streams_apart_are_refused(changes, reason):
    check_config(read_config(Config(WITH_MEMORY)))
    with pytest.raises(ValueError, match=reason):
        check_config(read_config(Config({**WITH_MEMORY, **changes})))
    check_config(read_config(Config({**WITH_MEMORY, **changes, "model": {"temporal": None}})))


@pytest.mark.parametrize(
    "loop", [{"type": "IterBasedTrainLoop", "max_iters": 10}, {"by_epoch": False, "max_iters": 10}]
)
@pytest.mark.parametrize("name", ["gsmap_stream_r18_minicity", "hrmapnet_r18_minicity"])
def test_a_loop_that_would_empty_the_memory_in_each_iteration_is_refused(name, loop):
    cfg = read_config(name)
    cfg.param_scheduler = []
    check_config(cfg)
    cfg.train_cfg = loop
    cfg.default_hooks.checkpoint.by_epoch = False
    with pytest.raises(ValueError, match=r"train_cfg counts iterations, .*'EpochBasedTrainLoop'"):
        check_config(cfg)
    cfg.model.temporal = None
    cfg.model.prior = None
    check_config(cfg)


@pytest.mark.parametrize(
    ("loop", "by_epoch", "reason"),
    [
        ({"by_epoch": True, "max_epochs": 2}, False, "counts epochs .*by_epoch=True"),
        ({"type": "EpochBasedTrainLoop", "max_epochs": 2}, False, "counts epochs .*by_epoch=True"),
        ({"by_epoch": False, "max_iters": 2}, True, "counts iterations .*by_epoch=False"),
        ({"type": "IterBasedTrainLoop", "max_iters": 2}, True, "counts iterations .*by_epoch=Fa"),
    ],
)
def test_checkpoints_that_count_otherwise_than_the_loop_are_refused(loop, by_epoch, reason):
    cfg = {"train_cfg": loop, "default_hooks": {"checkpoint": {"by_epoch": by_epoch}}}
    with pytest.raises(ValueError, match=f"train_cfg {reason}") as error:
        check_config(Config(cfg))
    assert "--resume could not continue where a training stopped" in str(error.value)
    check_config(Config({**cfg, "default_hooks": {"checkpoint": {"by_epoch": not by_epoch}}}))
    check_config(Config({**cfg, "default_hooks": {"checkpoint": None}}))
    check_config(Config({**cfg, "train_cfg": None}))


@pytest.mark.parametrize(("name", "value"), [("out_dir", "x"), ("filename_tmpl", "mine_{}.pth")])
def test_checkpoints_that_resumption_would_not_find_are_refused(name, value):
    cfg = Config({"default_hooks": {"checkpoint": {name: value}}})
    with pytest.raises(ValueError, match=rf"default_hooks\.checkpoint\.{name} is set, but"):
        check_config(cfg)


@pytest.mark.parametrize(
    "option",
    [
        "default_hooks.checkpoint.filename_tmpl=mine_{}.pth",
        "default_hooks.checkpoint.by_epoch=False",
        "param_scheduler.1.T_max=7",
        "optim_wrapper.optimizer.type=Nothing",
        "train_dataloader.sampler.type=DefaultSampler",
        "train_dataloader.dataset.pipeline=[]",
        "train_cfg.type=IterBasedTrainLoop",
    ],
)
def test_a_config_that_cannot_be_trained_here_may_be_tested(option):
    args = parse("gsmap_stream_r18_minicity", "--cfg-options", option)
    load_config(args, for_training=False)
    with pytest.raises(ValueError, match="gsmap_stream_r18_minicity"):
        load_config(args)


def test_a_memory_of_elements_alone_is_not_trained_and_needs_order_in_tests_only():
    train = {"train_dataloader": {"batch_size": 2, "sampler": {"type": "DefaultSampler"}}}
    elements = {**WITH_MEMORY, **train, "model": {"temporal": {"elements": {}}}}
    check_config(read_config(Config(elements)))
    both = {"model": {"temporal": {"elements": {}, "bev": {}}}}
    with pytest.raises(ValueError, match=r"train_dataloader\.sampler"):
        check_config(read_config(Config({**elements, **both})))
    torn = {"test_dataloader": {"sampler": {"type": "DefaultSampler"}}}
    with pytest.raises(ValueError, match=r"test_dataloader\.sampler"):
        check_config(read_config(Config({**elements, **torn})))


def test_the_newest_whole_checkpoint_is_found_whatever_is_noted(tmp_path, capsys):
    assert newest_checkpoint(tmp_path) is None
    for number in (2, 9, 10, 11):
        torch.save({"state_dict": {"w": torch.ones(1000)}}, tmp_path / f"epoch_{number}.pth")
    (tmp_path / "last_checkpoint").write_text(str(tmp_path / "epoch_2.pth"))
    (tmp_path / "best.pth").write_bytes(b"")
    assert newest_checkpoint(tmp_path).name == "epoch_11.pth"
    content = bytearray((tmp_path / "epoch_11.pth").read_bytes())
    content[len(content) // 2] ^= 255  # one byte of a weight
    (tmp_path / "epoch_11.pth").write_bytes(content)
    (tmp_path / "epoch_10.pth").write_bytes(content[:100])
    assert newest_checkpoint(tmp_path).name == "epoch_9.pth"
    assert "epoch_10.pth is damaged and is passed over" in capsys.readouterr().out


def test_checkpoints_that_an_earlier_run_left_are_passed_over(tmp_path, capsys):
    for number, seconds in ((1, 90), (2, 100), (3, 110), (5, 50), (6, 60)):
        path = tmp_path / f"epoch_{number}.pth"
        torch.save({"state_dict": {"w": torch.ones(1)}}, path)
        os.utime(path, (seconds, seconds))
    noted = tmp_path / "last_checkpoint"
    for text in (b"", b"\xff/..", b"../keys", b"elsewhere/epoch_9.pth"):
        noted.write_bytes(text)
        assert newest_checkpoint(tmp_path).name == "epoch_6.pth"
    noted.write_text("elsewhere/epoch_2.pth")
    assert newest_checkpoint(tmp_path).name == "epoch_3.pth"  # saved, and killed before its note
    assert "epoch_5.pth, epoch_6.pth left out, from an earlier run" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("place", "value"),
    [(6, 200), (8, 1), (10, 9), (42, 0xFFFF_FFF0)],
    ids=["version", "encryption", "compression", "place"],
)
def test_a_checkpoint_with_a_damaged_list_of_contents_is_passed_over(tmp_path, place, value):
    for number in (1, 2):
        torch.save({"state_dict": {"w": torch.ones(1000)}}, tmp_path / f"epoch_{number}.pth")
    content = bytearray((tmp_path / "epoch_2.pth").read_bytes())
    entry = content.rindex(b"PK\x01\x02") + place
    content[entry : entry + 2 + 2 * (value > 999)] = value.to_bytes(2 + 2 * (value > 999), "little")
    (tmp_path / "epoch_2.pth").write_bytes(content)
    assert newest_checkpoint(tmp_path).name == "epoch_1.pth"
