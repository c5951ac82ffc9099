"""No file runs code: crafted files are read in processes of their own, and leave no marker."""

import json
import zipfile
from pathlib import Path

import pytest
import torch
import upstream_configs
from comparison.results import evaluator_for, read_result
from comparison.tables import markdown
from processes import run_python

from fuzz.attacks import CONFIG, PLANTED, config_corpus, corpus, plant, settings_corpus
from gsmap.apis.onnx_inferencer import METADATA_KEY, OnnxInferencer
from gsmap.checkpoints.settings import MODEL_SETTINGS, plain
from gsmap.datasets.annotations.file import AnnotationFile, write_annotations
from gsmap.datasets.annotations.record import AnnotationMeta
from gsmap.datasets.vectorized_map_dataset import VectorizedMapDataset
from gsmap.engine.launch import read_config
from gsmap.evaluation.core.file_evaluation import evaluate_files
from gsmap.evaluation.core.report import flat_metrics

pytestmark = pytest.mark.faults

SCRIPT = Path(__file__).with_name("attacks.py")
HARMLESS = {"open", "system", "exec", "eval", "makedirs", "nested", "key", "tofile"}
BUILT = {  # settings that do nothing if mmengine builds them
    "address", "deep", "endless", "hidden key", "no number", "text", "type of several",
    "unknown key",
}  # fmt: skip


def read_all(reader: str, folder: Path) -> dict[str, str]:
    """Read every file of a folder in one process; how each ended, by its name."""
    done = run_python(SCRIPT, reader, folder)
    assert done.returncode == 0, f"{done.stdout[-300:]}\n{done.stderr[-2000:]}"
    return dict(line.split(": ", 1) for line in done.stdout.splitlines())


def test_the_attacks_work_on_an_ordinary_reader(tmp_path: Path):
    attacks = corpus(tmp_path)
    for name in HARMLESS:
        (tmp_path / f"{name}.pkl").write_bytes(attacks[name])
    outcomes = read_all("python", tmp_path)
    assert {name for name, outcome in outcomes.items() if outcome.startswith("RAN")} == HARMLESS


@pytest.mark.parametrize("reader", ["plain", "infos", "sample"])
def test_no_pickle_runs_anything(reader: str, tmp_path: Path):
    attacks = corpus(tmp_path)
    for name, content in attacks.items():
        (tmp_path / f"{name}.pkl").write_bytes(content)
    outcomes = read_all(reader, tmp_path)
    assert outcomes.keys() == attacks.keys()
    del outcomes["huge memo"]  # a list and nothing else, if memory is not taken for its number
    for name, outcome in outcomes.items():
        assert outcome.startswith("did not run, InputError: "), f"{name}: {outcome}"
        assert "cannot be read as a pickle of plain data" in outcome, f"{name}: {outcome}"


@pytest.mark.parametrize("container", ["zip", "legacy"])
def test_no_checkpoint_runs_anything(container: str, tmp_path: Path):
    attacks = corpus(tmp_path)
    del attacks["huge memo"]  # torch's own reader keeps a dict, which is no trouble
    for name, content in attacks.items():
        path = tmp_path / f"{name}.pkl"
        if container == "legacy":
            path.write_bytes(content)
            continue
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("archive/data.pkl", content.replace(b"\x80\x04", b"\x80\x02", 1))
            archive.writestr("archive/version", "3\n")
    outcomes = read_all("weights", tmp_path)
    assert outcomes.keys() == attacks.keys()
    for name, outcome in outcomes.items():
        assert outcome.startswith("did not run, InputError: "), f"{name}: {outcome}"


@pytest.fixture
def checkpoints(tmp_path: Path) -> set[str]:
    """Write checkpoints with hostile settings into ``tmp_path``; return their names."""
    attacks = settings_corpus(tmp_path, plain(read_config(CONFIG).model.to_dict()))
    for name, settings in attacks.items():
        meta = {MODEL_SETTINGS: json.dumps(settings)}
        content = {"state_dict": {"w": torch.ones(1)}, "meta": meta}
        torch.save(content, tmp_path / f"{name}.pkl")
    return set(attacks)


def test_the_settings_would_run_if_they_were_built(checkpoints: set[str], tmp_path: Path):
    outcomes = read_all("settings as mmengine builds them", tmp_path)
    ran = {name for name, outcome in outcomes.items() if outcome.startswith("RAN")}
    assert ran == checkpoints - BUILT


def test_no_settings_of_a_checkpoint_run_anything(checkpoints: set[str], tmp_path: Path):
    outcomes = read_all("settings", tmp_path)
    assert outcomes.keys() == checkpoints
    for name, outcome in outcomes.items():
        assert outcome.startswith("did not run, InputError: "), f"{name}: {outcome}"
        assert f"{name}.pkl was not loaded, because its model settings are refused" in outcome, (
            f"{name}: {outcome}"
        )


def test_no_config_of_another_repository_runs_anything_or_hangs(tmp_path: Path):
    attacks = config_corpus(tmp_path, upstream_configs.maptr())
    for name, content in attacks.items():
        (tmp_path / f"{name}.pkl").write_text(content)
    outcomes = read_all("config", tmp_path)
    assert outcomes.keys() == attacks.keys()
    for name, outcome in outcomes.items():
        assert outcome.startswith("did not run, InputError: "), f"{name}: {outcome}"
        assert f"{name}.pkl" in outcome, f"{name}: {outcome}"
        assert not (tmp_path / f"{name}.py").exists()


@pytest.fixture
def words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names that would leave a marker if they were looked up; that none was is checked."""
    marker = Path(plant(tmp_path))
    monkeypatch.syspath_prepend(tmp_path)
    yield [PLANTED, f"{PLANTED}.print", f"mmdet.{PLANTED}", f"open({str(marker)!r}, 'w')"]
    assert not marker.exists()


def test_the_words_of_annotations_and_results_are_never_looked_up(
    words: list[str], minicity_annotations: dict[str, Path], tmp_path: Path
):
    first = words[0]
    notes = {"type": words[1], "custom_imports": words, "command": words[3]}
    meta = AnnotationMeta(
        dataset=first, frame="lidar", split=words[2], classes=tuple(words), command=words[3],
        source_fingerprint=first, versions={w: w for w in words}, options=notes,
    )  # fmt: skip
    path = tmp_path / "annotations.arrow"
    write_annotations(path, meta, AnnotationFile(minicity_annotations["val"]))
    dataset = VectorizedMapDataset(ann_file=str(path), pipeline=[], test_mode=True)
    assert dataset.metainfo["classes"] == tuple(words)
    vector = {"pts": [[0, 0], [9, 9]], "cls_name": words[1], "confidence_level": 0.5, "type": first}
    tokens = [sample.token for sample in AnnotationFile(path)]
    found = [{"sample_token": t, "vectors": [vector], "type": words[3]} for t in tokens]
    results = tmp_path / "results.json"
    results.write_text(json.dumps({"meta": notes, "type": words[1], "results": found}))
    (chamfer, *_), *_ = evaluate_files(results, path, evaluator_for(path, {}), 1)
    assert {f"chamfer/{word}/AP" for word in words} <= flat_metrics([chamfer]).keys()


def test_the_words_of_a_run_and_of_an_exported_model_are_never_looked_up(
    words: list[str], tmp_path: Path
):
    record = {"state": words[1], "machine": words[3], "type": words[0], "train": words}
    (tmp_path / "run.json").write_text(json.dumps(record))
    table = markdown([read_result(words[0], tmp_path, 0)], words[2], words[1])
    assert words[3] in table
    onnx = pytest.importorskip("onnx")
    shape = [len(words), 3, 1, 1]
    names = ("scores", "labels", "points")
    value, *results = (
        onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, shape)
        for name in ("images", *names)
    )
    nodes = [onnx.helper.make_node("Identity", ["images"], [name]) for name in names]
    graph = onnx.helper.make_graph(nodes, "g", [value], results)
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 18)])
    model.ir_version = 9
    notes = {"format": 1, "classes": words, "cameras": words, "image_size": [1, 1]}
    notes |= {"x_range": [-1, 1], "y_range": [-1, 1], "margin_m": None, "score_threshold": None}
    onnx.helper.set_model_props(
        model, {METADATA_KEY: json.dumps({**notes, "type": words[1], "frame": words[0]})}
    )
    onnx.save(model, tmp_path / "model.onnx")
    assert OnnxInferencer(tmp_path / "model.onnx").classes == tuple(words)
