"""No file runs code: crafted files are read in processes of their own, and leave no marker."""

import json
import zipfile
from pathlib import Path

import pytest
import torch
import upstream_configs
from processes import run_python

from fuzz.attacks import CONFIG, config_corpus, corpus, settings_corpus
from gsmap.checkpoints.settings import MODEL_SETTINGS, plain
from gsmap.engine.launch import read_config

SCRIPT = Path(__file__).with_name("attacks.py")
HARMLESS = {"open", "system", "exec", "eval", "makedirs", "nested", "key", "tofile"}
BUILT = {  # settings that do nothing if mmengine builds them
    "address", "deep", "endless", "hidden key", "no number", "text", "type of several",
    "unknown key",
}  # fmt: skip


def read_all(reader: str, folder: Path) -> dict[str, str]:
    """Read every file of a folder in one process; how each ended, by its name."""
    done = run_python(SCRIPT, reader, folder, timeout=120)
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
        assert outcome.startswith("did not run, ValueError: "), f"{name}: {outcome}"
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
        assert outcome.startswith("did not run, ValueError: "), f"{name}: {outcome}"


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
        assert outcome.startswith("did not run, ValueError: "), f"{name}: {outcome}"
        assert f"{name}.pkl was not loaded: of the settings in it" in outcome, f"{name}: {outcome}"


def test_no_config_of_another_repository_runs_anything_or_hangs(tmp_path: Path):
    attacks = config_corpus(tmp_path, upstream_configs.maptr())
    for name, content in attacks.items():
        (tmp_path / f"{name}.pkl").write_text(content)
    outcomes = read_all("config", tmp_path)
    assert outcomes.keys() == attacks.keys()
    for name, outcome in outcomes.items():
        assert outcome.startswith("did not run, ValueError: "), f"{name}: {outcome}"
        assert f"{name}.pkl" in outcome, f"{name}: {outcome}"
        assert not (tmp_path / f"{name}.py").exists()
