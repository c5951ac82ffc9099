"""No output of a command is one of its inputs."""

import json
import os
import re
import socket
from pathlib import Path

import pytest
from processes import REPO, run_tool

from gsmap.datasets.annotations.file import AnnotationFile, write_annotations
from gsmap.utils.cli import CommandParser, output_file, run_command
from gsmap.utils.files import write_text
from gsmap.utils.inputs import InputReplacedError, check_input
from gsmap.utils.parallel import ordered_map


def copying(folder: Path, *words: str, reads: str = "given") -> None:
    """Run a command that reads a file and writes another."""

    def command() -> None:
        parser = CommandParser("copy")
        parser.add_argument("given")
        parser.add_argument("--folder", type=Path)
        parser.add_argument("--out", type=output_file)
        parser.add_argument("--table", type=output_file)
        args = parser.parse_args(words)
        name = folder / reads if reads != "given" else args.given
        text = Path(name).read_text()
        write_text(args.out or args.folder / "out", text.upper())

    run_command(command)


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "in").write_text("text")
    (tmp_path / "link").symlink_to("in")
    os.link(tmp_path / "in", tmp_path / "hard")
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "read").write_text("read")
    return tmp_path


@pytest.mark.parametrize("out", ["in", "link", "hard", "deep/../in"])
def test_an_output_is_never_an_input_by_whatever_name(out, folder, capsys):
    with pytest.raises(SystemExit) as end:
        copying(folder, str(folder / "in"), "--out", str(folder / out))
    assert end.value.code == 2
    said = capsys.readouterr().err
    assert f"error: --out {folder / out} would replace what this command reads" in said
    assert (folder / "in").read_text() == "text"
    assert (folder / "link").is_symlink()


def test_what_no_argument_names_is_an_input_too_once_it_is_read(folder, capsys):
    words = [str(folder / "in"), "--out", str(folder / "deep/read")]
    with pytest.raises(SystemExit):
        copying(folder, *words, reads="deep/read")
    assert "--out" in capsys.readouterr().err
    assert (folder / "deep/read").read_text() == "read"
    copying(folder, *words)  # it is an earlier output where nothing reads it
    assert (folder / "deep/read").read_text() == "TEXT"
    copying(folder, str(folder / "in"), "--out", str(folder / "deep/read"))


def test_an_input_is_kept_where_the_command_names_its_files(folder, capsys):
    (folder / "out").write_text("mine")
    with pytest.raises(SystemExit):
        copying(folder, str(folder / "out"), "--folder", str(folder))
    assert "out would replace what this command reads" in capsys.readouterr().err
    assert (folder / "out").read_text() == "mine"


def test_an_output_may_be_read_once_it_is_written(folder):
    out = folder / "earlier"
    out.write_text("old")

    def command() -> str:
        parser = CommandParser("copy")
        parser.add_argument("--out", type=output_file)
        path = parser.parse_args(["--out", str(out)]).out
        with pytest.raises(
            InputReplacedError, match="earlier would replace what this command reads"
        ):
            path.read_text()
        write_text(path, "new")
        return path.read_text()

    run_command(command)
    assert out.read_text() == "new"
    check_input(out)  # the command has ended


@pytest.mark.parametrize("kind", ["pipe", "socket", "device", "link to a pipe"])
def test_a_command_reads_plain_files_alone(kind, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    if kind == "socket":
        socket.socket(socket.AF_UNIX).bind("in")
    elif kind == "device":
        Path("in").symlink_to("/dev/zero")
    else:
        os.mkfifo("pipe")
        Path("in").symlink_to("pipe")
    name = "pipe" if kind == "pipe" else "in"
    with pytest.raises(SystemExit) as end:
        copying(tmp_path, name, "--out", "out")
    assert end.value.code == 2
    assert f"error: {name} is a pipe, a socket or a device" in capsys.readouterr().err
    copying(tmp_path, os.devnull, "--out", "out")
    assert Path("out").read_text() == ""


@pytest.mark.parametrize(
    "words",
    [
        "tools/evaluate.py @pipe @a.arrow",
        "tools/build_map.py @pipe --ann @a.arrow --out @maps",
        "tools/report.py @pipe --ann @a.arrow --out @page.html",
        "tools/compact_results.py @pipe @out.json",
        "tools/convert_config.py @pipe @out.py",
        "tools/infer.py @pipe.mcap --check-calibration @out.png",
        "tools/infer.py @pipe.db3 --check-calibration @out.png",
        "tools/build_map.py @r.json --ann @a.arrow --out @maps --formats mcap",
        "tools/report.py @r.json --ann @a.arrow --out @page.html",
    ],
)
def test_no_command_waits_for_a_pipe(words, minicity_annotations, tmp_path):
    """Each file that it reads may be one; the last two find it in the place of an image."""
    annotations = AnnotationFile(minicity_annotations["val"])
    sample = annotations[0]
    write_annotations(tmp_path / "a.arrow", annotations.meta, [sample])
    results = {"results": [{"sample_token": sample.token, "vectors": []}]}
    (tmp_path / "r.json").write_text(json.dumps(results))
    image = tmp_path / sample.cameras[0].path
    image.parent.mkdir(parents=True)
    for pipe in ("pipe", "pipe.mcap", "pipe.db3"):
        os.mkfifo(tmp_path / pipe)
    os.mkfifo(image)
    tool, *rest = words.replace("@", f"{tmp_path}/").split()
    ended = run_tool(REPO / tool, *rest)
    assert ended.returncode == 2, ended.stderr
    last = ended.stderr.splitlines()[-1]
    assert re.search("error: .*(is a pipe, a socket or a device|no readable image at)", last)


@pytest.mark.faults
def test_no_worker_waits_for_a_pipe(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ValueError, match="is a pipe, a socket or a device"):
        list(ordered_map(Path.read_bytes, 2 * [tmp_path / "pipe"], workers=2))


def test_two_options_cannot_name_one_file(folder, capsys):
    for other in ("x", "deep/../x"):
        both = ["--out", str(folder / "x"), "--table", str(folder / other)]
        with pytest.raises(SystemExit):
            copying(folder, str(folder / "in"), *both)
        assert "--out and --table both name" in capsys.readouterr().err
    copying(folder, str(folder / "in"), "--out", os.devnull, "--table", os.devnull)


@pytest.mark.parametrize(
    "words",
    [
        "tools/create_data.py export ANN ANN",
        "tools/create_data.py export ANN HARD",
        "tools/create_data.py overlap ANN ANN --out ANN",
        "tools/evaluate.py R ANN --eval chamfer --out R",
        "tools/evaluate.py R ANN --eval chamfer --pr-curves ANN",
        "tools/evaluate.py R ANN --eval chamfer --by GROUPS --out GROUPS",
        "tools/compact_results.py R LINK",
        "tools/report.py R --ann ANN --no-images --out PAGE",
        "tools/convert_config.py CONFIG CONFIG",
        "tools/analyze_run.py SCALARS --table SCALARS",
        "tools/infer.py ROOT --check-calibration IMAGE",
    ],
)
def test_commands_keep_what_they_read(words, minicity_root, minicity_annotations, tmp_path):
    annotations = tmp_path / "a.arrow"
    annotations.write_bytes(minicity_annotations["val"].read_bytes())
    results, config = tmp_path / "r.json", tmp_path / "config.py"
    tokens = AnnotationFile(annotations).column("token")
    rows = ", ".join(f'{{"sample_token": "{t}", "vectors": []}}' for t in tokens)
    results.write_text(f'{{"results": [{rows}]}}')
    (tmp_path / "link.json").symlink_to(results)
    os.link(annotations, tmp_path / "hard.arrow")
    os.link(annotations, tmp_path / "hard.html")
    config.write_text("model = dict(type='MapTR')\n")
    groups, scalars = tmp_path / "groups.json", tmp_path / "scalars.json"
    groups.write_text("{" + ", ".join(f'"{t}": "day"' for t in tokens) + "}")
    scalars.write_text('{"loss": 1.0, "step": 1, "iter": 1}\n')
    root = tmp_path / "root"
    root.mkdir()
    for name in ("v1.0-trainval", "can_bus", "maps"):
        (root / name).symlink_to(minicity_root / name)
    camera = next((minicity_root / "samples").glob("CAM_FRONT"))
    copies = root / "samples"
    for folder in camera.parent.iterdir():
        (copies / folder.name).mkdir(parents=True)
        for file in folder.iterdir():
            os.link(file, copies / folder.name / file.name)
    image = min((copies / "CAM_FRONT").iterdir())
    places = {
        "ANN": annotations, "HARD": tmp_path / "hard.arrow", "R": results, "CONFIG": config,
        "LINK": tmp_path / "link.json", "GROUPS": groups, "SCALARS": scalars, "ROOT": root,
        "IMAGE": image, "PAGE": tmp_path / "hard.html",
    }  # fmt: skip
    before = {path: path.read_bytes() for path in places.values() if path.is_file()}
    tool, *rest = words.split()
    ended = run_tool(REPO / tool, *(places.get(word, word) for word in rest))
    assert ended.returncode == 2, ended.stderr
    assert "would replace what this command reads" in ended.stderr
    assert {path: path.read_bytes() for path in before} == before
