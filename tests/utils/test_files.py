import errno
import os
import platform
import signal
import stat
import subprocess
import sys
import textwrap

import pytest

from gsmap.utils.files import atomic_write, file_name, write_bytes, write_text


def test_text_and_bytes_are_written_and_folders_made(tmp_path):
    write_text(tmp_path / "new/a.txt", "höhe\n")
    write_bytes(str(tmp_path / "new/b.bin"), b"\x00\xff")
    assert (tmp_path / "new/a.txt").read_bytes() == "höhe\n".encode()
    assert (tmp_path / "new/b.bin").read_bytes() == b"\x00\xff"
    assert sorted(os.listdir(tmp_path / "new")) == ["a.txt", "b.bin"]


def test_the_file_has_the_mode_that_the_umask_leaves(tmp_path):
    before = os.umask(0o027)
    try:
        write_text(tmp_path / "a", "")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "a").stat().st_mode) == 0o640


def test_the_old_file_stays_until_the_block_ends(tmp_path):
    path = tmp_path / "a"
    path.write_text("old")
    with atomic_write(path) as file:
        file.write("new")
        assert path.read_text() == "old"
        assert [p for p in os.listdir(tmp_path) if p.endswith(".partial")]
    assert path.read_text() == "new"


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, SystemExit, OSError])
def test_an_exception_keeps_the_old_file_and_leaves_nothing_behind(error, tmp_path):
    path = tmp_path / "a"
    path.write_text("old")

    def interrupted() -> None:
        with atomic_write(path) as file:
            file.write("new")
            raise error

    with pytest.raises(error):
        interrupted()
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["a"]


def test_what_a_killed_writer_left_goes_with_the_next_write_and_nothing_else(tmp_path):
    path = tmp_path / "a"
    code = textwrap.dedent(
        f"""
        import time
        from gsmap.utils.files import atomic_write
        with atomic_write({str(path)!r}) as file:
            file.write("half")
            print("ready", flush=True)
            time.sleep(60)
        """
    )
    host = platform.node()
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as writer:
        assert writer.stdout.readline() == b"ready\n"
        write_text(path, "beside a living writer")
        assert (tmp_path / f"a.{writer.pid}.{host}.partial").exists()
        writer.send_signal(signal.SIGKILL)
    (tmp_path / f"folder.{writer.pid}.{host}.partial").mkdir()
    (old := tmp_path / "e.999999999.there.partial").touch()
    os.utime(old, (0, 0))
    others = {
        f"b.1.{host}.partial",
        "a.partial",
        f"a.x.{host}.partial",
        "a.999999999.there.partial",
    }
    for name in others:
        (tmp_path / name).touch()
    write_text(tmp_path / "d", "whole")  # any file of that folder
    assert set(os.listdir(tmp_path)) == {"a", "d", *others}


def test_a_device_or_a_pipe_is_written_to_and_stays_what_it_is(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    reader = os.open(tmp_path / "pipe", os.O_RDONLY | os.O_NONBLOCK)
    write_text(tmp_path / "pipe", "figures")
    assert os.read(reader, 100) == b"figures"
    os.close(reader)
    write_text("/dev/null", "figures")
    assert stat.S_ISCHR(os.stat("/dev/null").st_mode)


def test_what_stops_a_writer_is_said_of_the_file_that_was_asked_for(tmp_path, monkeypatch):
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    (tmp_path / "folder").mkdir()
    with pytest.raises(IsADirectoryError, match=r"Is a directory: '.*/folder'$"):
        write_text(tmp_path / "folder", "")
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match=r"No space left on device: '.*/a'$"):
        write_text(tmp_path / "a", "")
    assert os.listdir(tmp_path) == ["folder"]


@pytest.mark.parametrize(
    "name", ["", ".", "..", "../x", "/abs/x", "a/b", "a\\b", "a\0b", ".lock", "-rf", "x" * 300]
)
def test_a_foreign_name_becomes_one_part_of_a_path(name, tmp_path):
    made = file_name(name)
    path = (tmp_path / f"{made}.json").resolve()
    assert path.parent == tmp_path
    write_text(path, "x")
    assert made[0] not in ".-"
    assert made != file_name(name + "/")


def test_a_good_name_stays_and_two_names_never_make_one_file():
    assert file_name("scene-0001_Straße.+=") == "scene-0001_Straße.+="
    assert len({file_name(name) for name in ("a_b", "a/b", "a\\b", "a b", "/a_b")}) == 5
