"""Every command ends in one line and exit code 2, whatever a user gives it."""

import importlib
import json
import pickle
from pathlib import Path

import pytest
import torch
from mmdet3d.registry import MODELS

from gsmap.checkpoints.strict import neutral_keys
from gsmap.engine.launch import read_config
from gsmap.utils.cli import run_command
from gsmap.utils.files import SUFFIX

COMMANDS = {
    "create_data": "make",
    "benchmarks": "main",
    "minicity": "main",
}
CONTENTS = {
    "damaged.arrow": bytes(range(256)) * 4,
    "damaged.json": b'{"results": [',
    "list.json": b"[1, 2]",
    "nothing.json": b'{"results": []}',
    "other.json": b'{"results": [{"sample_token": "x", "vectors": []}]}',
    "damaged.pth": bytes(range(256)) * 4,
    "list.pkl": pickle.dumps([1]),
    "open.py": b"model = dict(\n",
    "zero.py": b"\nx = 1 / 0\n",
    "base.py": b"_base_ = './nowhere.py'\n",
    "scope.py": b"_base_ = 'gsmap::maptr/maptr_r50_24e.py'\n",
    "bytes.py": b"\xff\xfe",
    "empty.py": b"",
    "plain.txt": b"hello",
}

CASES = """
infer: VAL --model nowhere.py K --out out.json | There is no config file nowhere.py
infer: VAL --model gsmap_r18_minicit K --out out.json | did you mean gsmap_r18_minicity?
infer: VAL --model open.py K --out out.json | open.py cannot be used: SyntaxError
infer: VAL --model zero.py K --out out.json | zero.py, line 2, cannot be used: ZeroDivisionError
infer: VAL --model base.py K --out out.json | base.py cannot be used: FileNotFoundError
infer: VAL --model scope.py K --out out.json | scope.py cannot be used: ValueError: 'gsmap::' is not read in _base_; write a path below
infer: VAL --model bytes.py K --out out.json | bytes.py cannot be used: UnicodeDecodeError
infer: VAL --model plain.txt K --out out.json | plain.txt cannot be used: OSError: Only py
infer: VAL --model empty.py K --out out.json | empty.py: a setting is missing:
infer: VAL --model C --out out.json | give a checkpoint after
infer: VAL --model C nowhere.pth --out out.json | There is no checkpoint nowhere.pth
infer: VAL --model C damaged.pth --out out.json | damaged.pth was not loaded: it is broken
infer: VAL --model C foreign.pth --out out.json | foreign.pth does not belong to this config
infer: VAL --model C maptr.pth --out out.json | maptr.pth does not belong to this config: the checkpoint was never trained with parts of the config's model: map_head.decoder.layers.0.guidance
infer: nowhere --model C K --out out.json | There is no input nowhere
infer: damaged.arrow --model C K --out out.json | damaged.arrow is not a whole annotation file
infer: list.pkl --model C K --out out.json | list.pkl
infer: plain.txt --model C K --out out.json | plain.txt is no input: it must be an annotation file
infer: VAL --model C K | give --out FILE
infer: VAL --model C K --out . | Is a directory: '.'; name a file in it.
infer: VAL --model C K --out plain.txt/a.json | plain.txt'; a part of that path is a file.
infer: VAL --model C K --out out.json --token abc | No sample has the token 'abc'
infer: VAL --model C K --out out.json --max-samples 0 | must be >= 1, got 0
infer: VAL --model C K --out out.json --data-root . | no image at
infer: VAL --model C K --show-dir out --width -5 | --width must be >= 1 pixel, got -5
infer: VAL --model C K --out out.json --device tpu | the device that was asked for
infer: VAL --model C K --out out.json --cfg-options modl.x=1 | 'modl'; did you mean 'model'?
infer: VAL --model C K --out out.json --cfg-options model.map_hed.num=3 | MapDetector has no setting 'map_hed'; did you mean 'map_head'?
infer: VAL --model C K --out out.json --cfg-options model.map_head.type=GSMapHed | there is no model of type 'GSMapHed'; did you mean 'GSMapHead'?
infer: VAL --model C K --out out.json --cfg-options model.map_head.embed_dims=-16 | tiny.py: GaussianReference of GSMapHead of MapDetector cannot be made from these settings (model.map_head.embed_dims=-16)
infer: VAL --model C K --out out.json --cfg-options model.map_head.embed_dims=abc | --cfg-options model.map_head.embed_dims must be a number, got 'abc'
infer: VAL --model C K --out out.json --cfg-options model.classes=[a] | K does not belong to this config
infer: VAL --model C K --out out.json --cfg-options test_dataloader.dataset.clas_ses=[a] | VectorizedMapDataset has no setting 'clas_ses'; did you mean 'classes'?
infer: VAL --model C K --out out.json --cfg-options test_dataloader.dataset.classes=[a] | VAL was made with classes
infer: VAL --model C K --out out.json --cfg-options test_dataloader.dataset.pipeline.9.type=x | --cfg-options of C cannot be used
infer: VAL --model C K --out out.json --cfg-options custom_imports.imports=[nothing] | No module named 'nothing'; install it, or name its folder in PYTHONPATH.
infer: VAL --model C K --out out.json --cfg-options visualizer.widht_px=3 | has no setting 'widht_px'; did you mean 'width_px'?
train: nowhere.py | There is no config file nowhere.py
train: C --work-dir plain.txt | plain.txt
train: C --work-dir w --cfg-options load_from=nowhere.pth | There is no checkpoint nowhere.pth
train: C --work-dir w --resume nowhere.pth | There is no checkpoint nowhere.pth
train: C --work-dir w --cfg-options train_dataloader.batch_sise=2 | has no setting 'batch_sise'; did you mean 'batch_size'?
train: C --cfg-options work_dir | argument --cfg-options: 'work_dir' is no KEY=VALUE with closed brackets
train: C --cfg-options param_scheduler=[1,[2] | 'param_scheduler=[1,[2]' is no KEY=VALUE
train: C --cfg-options param_scheduler=[dict(a=1,b=2)] | settings of a dictionary one by one, by KEY.NAME=VALUE
train: C --work-dir w --cfg-options train_cfg.max_epoch=2 | has no setting 'max_epoch'; did you mean 'max_epochs'?
train: C --work-dir w --cfg-options default_hooks.logger.intervl=2 | has no setting 'intervl'; did you mean 'interval'?
train: C --work-dir w --cfg-options optim_wrapper.optimizer.type=AdmW | there is no optimizer of type 'AdmW'; did you mean 'AdamW'?
train: C --work-dir w --cfg-options runner_type=FlexibelRunner | there is no runner of type 'FlexibelRunner'; did you mean 'FlexibleRunner'?
train: C --work-dir w --cfg-options randomness.sede=2 | has no setting 'sede'; did you mean 'seed'?
train: C --work-dir w --cfg-options train_dataloader.dataset.data_root=nowhere | no annotation file at nowhere
train: C --work-dir w --cfg-options train_dataloader.dataset.cameras=[A] train_dataloader.num_workers=1 | has no camera 'A'
train: C --work-dir w --cfg-options optim_wrapper.clip_grad.max_norm=abc | --cfg-options optim_wrapper.clip_grad.max_norm must be a number, got 'abc': it is 35 in
train: C --work-dir w --cfg-options optim_wrapper.optimizer=AdamW | --cfg-options optim_wrapper.optimizer must be dict(...)
train: C --work-dir w --cfg-options param_scheduler=[abc] | param_scheduler must be a list of dict(...), got ['abc']
train: C --work-dir w --cfg-options train_cfg.max_epochs=0 | train_cfg.max_epochs must be an integer >= 1, got 0
train: C --work-dir w --cfg-options val_cfg.fp16=abc | val_cfg.fp16 must be True or False, got 'abc'
train: C --work-dir w --cfg-options val_evaluator.thresholds=abc | thresholds must be > 0 m, at least one, got 'abc'
train: C --work-dir w --cfg-options train_cfg.val_interval=0 | train_cfg.val_interval must be an integer >= 1, got 0
train: C --work-dir w --cfg-options env_cfg.dist_cfg.backend=foo | env_cfg.dist_cfg.backend must be one of
train: C --work-dir w --cfg-options load_from=5 | load_from must be a path, got 5
train: C --work-dir w --cfg-options model.map_head.decoder.num_layers=-2 | num_layers must be more than 0, got -2
train: C --work-dir w --cfg-options model.data_preprocessor.pad_size_divisor=0 | ZeroDivisionError: division by zero, in code that uses --cfg-options model.data_preprocessor.pad_size_divisor=0
train: C --work-dir w --cfg-options model.map_head.loss_cls.loss_weight=[1] | in code that uses --cfg-options model.map_head.loss_cls.loss_weight=[1]: check this value
train: C --work-dir w --cfg-options model.map_head.embed_dims=-16 | cannot be made from these settings (model.map_head.embed_dims=-16):
train: C --work-dir w --cfg-options optim_wrapper.optimizer.betas=0.9 | AdamW cannot be made from these settings (optim_wrapper.optimizer.betas=0.9):
test: C K --work-dir w --cfg-options test_evaluator.thresholds=[a] | thresholds must be > 0 m, at least one, got ['a']
test: nowhere.py K | There is no config file nowhere.py
test: C nowhere.pth | There is no checkpoint nowhere.pth
test: C foreign.pth --work-dir w | the checkpoint does not fit the model
test: C maptr.pth --work-dir w | or use these parts with their initial weights: --cfg-options model.allow_untrained=True
export: C maptr.pth --out out.onnx | was never trained with parts
test: C K --eval | Nothing to do
test: C K --eval chamfr --work-dir w | there is no metric ['chamfr']; there are
test: C K --out . | Is a directory
test: C K --work-dir w --cfg-options test_dataloader.dataset.data_root=nowhere | no annotation file at nowhere
browse_dataset: empty.py | empty.py has no train_dataloader.dataset
browse_dataset: C --num 0 | must be >= 1, got 0
browse_dataset: C --web . | Is a directory
browse_dataset: C --show-dir plain.txt | File exists: 'plain.txt'
browse_dataset: C --cfg-options train_dataloader.dataset.pipeline.0.type=LoadCameraImage | there is no transform of type 'LoadCameraImage'; did you mean 'LoadCameraImages'?
infer: VAL --model C K --out out.json --shard 2/2 | expected I/N with I from 0 to N - 1
infer: VAL --model C K --out out.json --executor ray --shards 0 | --executor needs --shards N
evaluate: nothing.json VAL --custom-imports mine | mine cannot be imported: No module named 'mine'; install it, or name its folder in PYTHONPATH.
evaluate: nothing.json VAL --shard 0/2 | --shard needs --out
evaluate: nothing.json VAL --shard / --out out.json | expected I/N with I from 0 to N - 1
evaluate: nowhere.json VAL | No such file or directory: 'nowhere.json'; check the path.
evaluate: damaged.json VAL | damaged.json is empty or holds no complete list
evaluate: list.json VAL | list.json holds a list and no list under 'results'
evaluate: VAL nothing.json | holds ground truth: name the result file before it
evaluate: nothing.json VAL | 2 samples have no results
evaluate: nothing.json damaged.arrow | damaged.arrow is not a whole annotation file
evaluate: nothing.json VAL --classes a | has the classes
evaluate: nothing.json VAL --thresholds nan | --thresholds must be a number, got nan
evaluate: nothing.json VAL --polygon-classes divder | no class 'divder'; did you mean 'divider'?
evaluate: nothing.json VAL --range 3 3 1 1 | x_range must be (low, high)
evaluate: nothing.json VAL --out . | Is a directory
evaluate: nothing.json VAL --bootstrap 1 | intervals need two scenes, two resamples
evaluate: nothing.json nothing.json --against nothing.json | no list under 'GTs'
evaluate: nothing.json VAL --shard 0/2 --out o.json --bootstrap | --bootstrap needs all samples: leave out --shard
evaluate: nothing.json VAL --by weather | --by takes scene, map, distance or a file
evaluate: VAL --prior nowhere.arrow | no annotation file at nowhere.arrow
report: damaged.json --ann VAL | damaged.json is empty or holds no complete list
report: nothing.json --ann VAL | nothing.json: 2 samples have no results
report: nothing.json --ann VAL --out . | Is a directory
report: nothing.json --ann VAL --allow-mismatch --data-root . --out r.html | no readable image at
report: nothing.json --ann VAL --scene a --out r.html | --scene applies to films
report: nothing.json --ann VAL --by map --out r.mp4 | --by, --allow-mismatch and --image-width apply to
report: nothing.json --ann VAL --image-width 90 --out r.mp4 | and --image-width apply to pages
report: nothing.json --ann VAL --scene a --out r.mp4 | no scene 'a': give one of
build_map: damaged.json --ann VAL --out maps | damaged.json is empty or holds no complete list
build_map: nothing.json --ann VAL --out maps | no sample of scene
build_map: nothing.json --ann VAL --out maps --scene a | has no scene 'a'
analyze_run: nowhere | No vis_data/scalars.json under nowhere
analyze_run: list.json | list.json holds no record of training
analyze_run: bytes.py | bytes.py cannot be read: it is UTF-16
analyze_run: log.json --keys los --out a.png | no run logged ['los']
analyze_run: log.json --out a.xyz | xyz
analyze_run: log.json --keys los | --keys draws a picture: give --out, too
convert_checkpoint: nowhere.pth out.pth | There is no checkpoint nowhere.pth
convert_checkpoint: foreign.pth out.pth | foreign.pth: keys that upstream's maptr does not have: layer0.weight
convert_checkpoint: K plain.txt | plain.txt exists already
convert_config: nowhere.py out.py | No such file or directory: 'nowhere.py'
convert_config: open.py out.py | open.py, line 1: '(' was never closed.
convert_config: bytes.py out.py | bytes.py cannot be read
convert_config: empty.py out.py | empty.py cannot be converted: None is not supported: model.type must be one of
create_data: nuscenes --root nowhere | no data set at nowhere
create_data: nuscenes --root . | no version 'v1.0-trainval' in .
create_data: av2 --root . | no folder val
create_data: av2 --root . --split-name lilja-near | no Argoverse 2 log in the folders train, val
create_data: split damaged.arrow --out own.json | damaged.arrow is not a whole annotation file
create_data: split VAL --out own.json --min-distance 1e6 | give a smaller --min-distance
create_data: overlap damaged.arrow VAL | damaged.arrow is not a whole annotation file
create_data: av2-render --root . --out r | no folder val
create_data: infos nowhere.pkl out.arrow --data-root . | nowhere.pkl
create_data: infos list.pkl out.arrow --data-root . | list.pkl
create_data: check nowhere.arrow | no annotation file at nowhere.arrow
create_data: check damaged.arrow | damaged.arrow is not a whole annotation file
create_data: export damaged.arrow out.json | damaged.arrow is not a whole annotation file
create_data: export VAL . | Is a directory: '.'
create_data: minicity --root plain.txt --scenes 2 | plain.txt exists and is not a complete MiniCity
create_data: minicity --root new --scenes 0 | scenes must be at least 2
minicity: draw nowhere | no MiniCity at nowhere
compare: --list --tables zzz | no table is named 'zzz'
compare: nowhere --budget 3 --out cmp | There is no config file nowhere
compare: maptr_r18_minicity --budget 3 --out cmp --init nowhere | There is no checkpoint nowhere
compare: --runs A=nowhere --out cmp | nowhere
compare: --runs A=nowhere --out cmp --rescore dim=2 --only A/seed_0 | leave out --only and --slurm
export: C K --out . | Is a directory
export: C nowhere.pth --out m.onnx | There is no checkpoint nowhere.pth
export: C K --out m.onnx --samples nowhere | nowhere
export: C K --out m.onnx --size 0 0 | size
merge: nowhere.arrow | there are no shards of nowhere.arrow
demo: --dir plain.txt --budget tiny | generate the towns of val ended with 2
benchmarks: parameters nowhere.py | There is no config file nowhere.py
benchmarks: parameters C --depth x | invalid int value
"""  # noqa: E501


@pytest.fixture(scope="module")
def folder(tiny_config, minicity_annotations, tmp_path_factory) -> Path:
    """A folder with bad files, and a whole checkpoint of the tiny model."""
    made = tmp_path_factory.mktemp("bad")
    for name, content in CONTENTS.items():
        (made / name).write_bytes(content)
    (made / "log.json").write_text(json.dumps({"loss": 1.0, "step": 1}) + "\n")
    (made / "tiny.py").write_text(tiny_config.read_text())
    torch.save({f"layer{i}.weight": torch.ones(3) for i in range(500)}, made / "foreign.pth")
    model = MODELS.build(read_config(tiny_config).model)
    state = model.state_dict()
    torch.save(state, made / "tiny.pth")
    of_maptr = state.keys() - set().union(*neutral_keys(model))
    torch.save({key: state[key] for key in of_maptr}, made / "maptr.pth")
    return made


def main_of(tool: str):
    name = f"{tool}.__main__" if tool in ("benchmarks", "minicity") else f"tools.{tool}"
    return getattr(importlib.import_module(name), COMMANDS.get(tool, "main"))


@pytest.mark.parametrize("case", CASES.strip().splitlines())
def test_bad_input_ends_in_one_line(case, folder, minicity_annotations, monkeypatch, capsys):
    command, _, expected = case.partition(" | ")
    tool, _, words = command.partition(": ")
    names = {"C": "tiny.py", "K": "tiny.pth", "VAL": str(minicity_annotations["val"])}
    monkeypatch.chdir(folder)
    monkeypatch.setattr("sys.argv", [f"{tool}.py", *(names.get(w, w) for w in words.split())])
    before = set(folder.rglob("*"))
    with pytest.raises(SystemExit) as left:
        run_command(main_of(tool))
    assert left.value.code == 2
    said = [line for line in capsys.readouterr().err.splitlines() if "error: " in line]
    for short, name in names.items():
        said = [line.replace(name, short) for line in said]
        expected = expected.replace(name, short)
    assert len(said) == 1
    assert expected in said[0]
    assert len(said[0]) < 1000  # ten lines of a terminal
    assert not {path.name for path in {*folder.rglob("*")} - before if path.suffix == SUFFIX}
