"""No file runs code: crafted pickles are read in processes of their own, and leave no marker."""

import zipfile
from pathlib import Path

import pytest
from processes import run_python

from fuzz.attacks import corpus

SCRIPT = Path(__file__).with_name("attacks.py")
HARMLESS = {"open", "system", "exec", "eval", "makedirs", "nested", "key", "tofile"}


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
