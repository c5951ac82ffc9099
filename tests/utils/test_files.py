import os
import platform
import signal
import stat
import subprocess
import sys
import textwrap

import pytest

from gsmap.utils.files import atomic_write, write_bytes, write_text


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
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as writer:
        assert writer.stdout.readline() == b"ready\n"
        write_text(path, "beside a living writer")
        assert (tmp_path / f"a.{writer.pid}.{platform.node()}.partial").exists()
        writer.send_signal(signal.SIGKILL)
    here = platform.node()
    others = {
        f"b.1.{here}.partial",
        "a.partial",
        f"a.x.{here}.partial",
        "a.999999999.there.partial",
    }
    for name in others:
        (tmp_path / name).touch()
    write_text(path, "whole")
    assert set(os.listdir(tmp_path)) == {"a", *others}
