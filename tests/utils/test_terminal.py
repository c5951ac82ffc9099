"""What files bring cannot make a terminal act."""

import io
import sys

import pytest
from processes import REPO, run_tool
from tqdm import tqdm

from gsmap.datasets.annotations.file import AnnotationFile, write_annotations
from gsmap.datasets.annotations.record import AnnotationMeta
from gsmap.utils.cli import run_command
from gsmap.utils.errors import InputError
from gsmap.utils.parallel import ordered_map
from gsmap.utils.progress import Progress
from gsmap.utils.terminal import PrintableStream, printable, unescaped_stream

TITLE = "\x1b]0;a new title\x07"


@pytest.mark.parametrize(
    ("text", "written"),
    [
        ("a\tb\nc", "a\tb\nc"),
        ("höhe 路 \N{MIDDLE DOT}", "höhe 路 \N{MIDDLE DOT}"),
        (TITLE, "\\x1b]0;a new title\\x07"),
        ("\x9b2J", "\\x9b2J"),
        ("over\rwritten\x7f\x00", "over\\rwritten\\x7f\\x00"),
        ("txt.\u202egpj", "txt.\\u202egpj"),
        ("\u2066a\u2069\u200f\u2028", "\\u2066a\\u2069\\u200f\\u2028"),
        ("\udc9b", "\\udc9b"),
        ("\U000e0041", "\\U000e0041"),
    ],
)
def test_control_characters_are_written_out(text, written):
    assert printable(text) == written
    stream = io.StringIO()
    assert PrintableStream(stream).write(text) == len(text)
    PrintableStream(stream).writelines([text])
    assert stream.getvalue() == 2 * written


def test_whatever_a_command_prints_is_printable(capsys):
    def command() -> str:
        print(TITLE)
        sys.stderr.write(TITLE)
        Progress.write(TITLE)
        return TITLE

    def failing() -> None:
        raise InputError(f"{TITLE} is no class")

    run_command(command)
    with pytest.raises(SystemExit):
        run_command(failing)
    printed = capsys.readouterr()
    assert "\x1b" not in printed.out + printed.err
    assert printed.out.count("\\x1b]0;a new title\\x07") == 3
    assert "error: \\x1b]0;a new title\\x07 is no class" in printed.err


def say(text: str) -> None:
    sys.stderr.write(f"{text}\n")
    sys.stderr.flush()


def test_workers_print_no_control_characters_either(capfd):
    list(ordered_map(say, [TITLE, TITLE], 2))
    said = capfd.readouterr().err
    assert said.count("\\x1b]0;a new title\\x07") == 2
    assert "\x1b" not in said


def test_a_bar_keeps_its_line_to_itself_where_texts_pass_by(monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    below = Terminal()
    stream = PrintableStream(below)
    monkeypatch.setattr("sys.stderr", stream)
    monkeypatch.setattr("sys.stdout", stream)
    assert unescaped_stream(stream) is below
    with Progress(total=2, mininterval=0) as bar:
        bar.update()
        tqdm.write("between")
        bar.update()
    lines = below.getvalue().split("\n")
    assert lines[0].rstrip().endswith("between")
    assert "\r" in below.getvalue()  # the bar overwrites itself


@pytest.mark.parametrize("name", ["command", "classes", "split", "dataset"])
@pytest.mark.parametrize("bad", [TITLE, "\x9b2J", "\u202e", "\n"])
def test_words_of_annotation_metadata_are_checked_where_they_are_read(name, bad, tmp_path):
    words = {"dataset": "d", "frame": "lidar", "split": "val", "classes": ("a", "b"), "command": ""}
    words[name] = ("a", f"b{bad}") if name == "classes" else f"x{bad}"
    write_annotations(tmp_path / "a.arrow", AnnotationMeta(**words), [])
    with pytest.raises(ValueError, match="must be plain text") as refused:
        AnnotationFile(tmp_path / "a.arrow")
    assert printable(str(refused.value)) == str(refused.value)


def test_commands_write_out_the_words_of_files(tmp_path):
    name = f"no{TITLE}.json"
    (tmp_path / name).write_text("{")
    ended = run_tool(REPO / "tools/evaluate.py", tmp_path / name, tmp_path / "a.json")
    assert ended.returncode == 2
    assert "\x1b" not in ended.stdout + ended.stderr
    source = tmp_path / "upstream.py"
    source.write_text(f"x = f'{TITLE}'\n")
    ended = run_tool(REPO / "tools/convert_config.py", source, tmp_path / "new.py")
    assert ended.returncode == 2
    assert "\x1b" not in ended.stdout + ended.stderr
