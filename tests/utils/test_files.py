import errno
import fcntl
import os
import resource
import signal
import stat
import subprocess
import sys
import unicodedata
from pathlib import Path

import pytest

from gsmap.utils.files import (
    SUFFIX,
    atomic_write,
    file_name,
    file_names,
    lock_folder,
    open_to_append,
    partial_path,
    register_folder,
    remove_link,
    require_no_link,
    write_bytes,
    write_text,
)


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
        assert [p for p in os.listdir(tmp_path) if p.endswith(SUFFIX)]
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


WRITES = """
import platform, signal, sys
from gsmap.utils.files import atomic_write
platform.node = lambda: "same"  # as in containers
with atomic_write(sys.argv[1]) as file:
    file.write("half")
    print("ready", flush=True)
    signal.pause()
"""


def writing(path: Path, *before: str) -> subprocess.Popen:
    """Start a process that has opened a file and does not end; words to go before its command."""
    command = [*before, sys.executable, "-c", WRITES, str(path)]
    writer = subprocess.Popen(command, stdout=subprocess.PIPE)
    assert writer.stdout.readline() == b"ready\n"
    return writer


def leftovers(folder: Path) -> list[str]:
    return [name for name in os.listdir(folder) if name.endswith(SUFFIX)]


@pytest.mark.faults
def test_what_a_killed_writer_left_goes_with_the_next_write_and_nothing_else(tmp_path):
    path = tmp_path / "a"
    with writing(path) as writer:
        (half,) = leftovers(tmp_path)
        write_text(path, "beside a living writer")
        assert leftovers(tmp_path) == [half]
        writer.kill()
    (tmp_path / f"folder{half.removeprefix('a')}").mkdir()
    foreign = half[: half.index("-") - 8] + "0" * 8 + half[half.index("-") :]  # another machine's
    (rested := tmp_path / f"rested_{foreign}").touch()
    os.utime(rested, (0, 0))
    others = {
        foreign,
        "film.mp4.123.partial",  # a download
        "a.999999999.here.partial",
        f"a{SUFFIX}",
        f"a.123{SUFFIX}",
    }
    for name in others:
        (tmp_path / name).touch()
        if name != foreign:
            os.utime(tmp_path / name, (0, 0))
    write_text(tmp_path / "d", "whole")  # any file of that folder
    assert set(os.listdir(tmp_path)) == {"a", "d", *others}


@pytest.mark.faults
def test_containers_of_one_name_leave_each_others_files_alone(tmp_path):
    """In a process namespace of its own a writer's number means nothing here."""
    space = ["unshare", "--user", "--map-root-user", "--pid", "--fork", "--kill-child"]
    if subprocess.run([*space, "true"], check=False, capture_output=True).returncode:
        pytest.skip("no process namespaces here")
    with writing(tmp_path / "a", *space) as writer:
        (half,) = leftovers(tmp_path)
        with writing(tmp_path / "b", *space) as other:
            assert half in leftovers(tmp_path)
            other.kill()
        write_text(tmp_path / "c", "")
        assert half in leftovers(tmp_path)
        writer.kill()


def test_without_locks_nothing_is_removed_by_guess(tmp_path, monkeypatch):
    with writing(tmp_path / "a") as writer:
        writer.kill()
    (half,) = leftovers(tmp_path)

    def none(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", none)
    write_text(tmp_path / "b", "")
    assert set(os.listdir(tmp_path)) == {half, "b"}


def test_a_file_that_is_removed_before_it_is_locked_is_made_again(tmp_path, monkeypatch):
    touch, made = Path.touch, []

    def swept(path: Path, **options: bool) -> None:
        touch(path, **options)
        made.append(path)
        if len(made) == 1:
            path.unlink()

    with partial_path(tmp_path / "a", swept) as left:
        assert left == made[1] != made[0]


@pytest.mark.faults
def test_a_folder_is_for_one_process_and_says_whose(tmp_path):
    here, (said, says) = tmp_path / "new", os.pipe()
    here.mkdir()
    (here / ".lock").write_bytes(b"\xff of another program")
    with pytest.raises(ValueError, match=r"\.lock is another program's file"):
        lock_folder(here, ".lock", "wait")
    assert (here / ".lock").read_bytes() == b"\xff of another program"
    (here / ".lock").write_bytes(b"")
    with lock_folder(here, ".lock", "wait"):
        worker = os.fork()  # one that outlives the block
        if worker == 0:
            os.write(says, b"started")
            signal.pause()
        who = f"new is in use by process {os.getpid()} on"
        with pytest.raises(RuntimeError, match=rf"{who} \S+ since 20[\d: -]+: wait."):
            lock_folder(here, ".lock", "wait")
        assert os.read(said, 7) == b"started"
    lock_folder(here, ".lock", "wait").close()
    os.kill(worker, signal.SIGKILL)
    os.waitpid(worker, 0)


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
    foreign = ["a_b", "a/b", "a\\b", "a b", "/a_b"]
    foreign += [file_name(name) for name in foreign[1:]]  # as one who knows the rule may name it
    assert len({file_name(name) for name in foreign}) == 9


def test_a_full_disk_is_told_whatever_a_library_says_of_it(tmp_path):
    """Writers of films and of MCAP have errors of their own for it."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)

    def write() -> None:
        with atomic_write(tmp_path / "a", "wb") as file:
            try:
                file.write(bytes(100_000))
            except OSError:
                raise RuntimeError("error in callback") from None

    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, limits[1]))
    try:
        with pytest.raises(OSError, match=r"File too large: '.*/a'$"):
            write()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("target", ["file", "folder", "nothing", "pipe"])
def test_a_link_is_replaced_and_not_followed(target, tmp_path):
    place = tmp_path / target
    if target == "file":
        place.write_text("theirs")
    elif target == "folder":
        place.mkdir()
    elif target == "pipe":
        os.mkfifo(place)
    link = tmp_path / "link"
    link.symlink_to(place)
    write_text(link, "ours")
    assert not link.is_symlink()
    assert link.read_text() == "ours"
    assert target != "file" or place.read_text() == "theirs"


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o664, 0o4755])
def test_a_file_that_is_replaced_keeps_its_permissions(mode, tmp_path):
    path = tmp_path / "secret"
    path.write_text("old")
    path.chmod(mode)
    with atomic_write(path) as file:
        assert stat.S_IMODE(os.fstat(file.fileno()).st_mode) == mode & 0o777
        file.write("new")
    assert stat.S_IMODE(path.stat().st_mode) == mode & 0o777


def test_the_system_s_own_links_are_followed():
    read, write = os.pipe()
    write_text(f"/dev/fd/{write}", "through")
    assert os.read(read, 7) == b"through"
    os.close(read)
    os.close(write)


@pytest.mark.parametrize("kind", ["link", "dangling", "hard", "pipe", "folder"])
def test_what_is_added_to_is_a_plain_file_of_its_own(kind, tmp_path):
    theirs, path = tmp_path / "theirs", tmp_path / "log"
    theirs.write_text("keys")
    make = {
        "link": lambda: path.symlink_to(theirs),
        "dangling": lambda: path.symlink_to(tmp_path / "new"),
        "hard": lambda: os.link(theirs, path),
        "pipe": lambda: os.mkfifo(path),
        "folder": path.mkdir,
    }
    make[kind]()
    with pytest.raises(ValueError, match="log is a link, a pipe or a folder"):
        open_to_append(path)
    with pytest.raises(ValueError, match="log is a link, a pipe or a folder"):
        lock_folder(tmp_path, "log", "wait")
    assert theirs.read_text() == "keys"
    assert not (tmp_path / "new").exists()
    if kind != "folder":
        remove_link(path)
        assert not path.exists()
        assert theirs.read_text() == "keys"
        with open_to_append(path) as file:
            file.write(b"a")
        with open_to_append(path) as file:
            file.write(b"b")
        remove_link(path)
        assert path.read_bytes() == b"ab"


def test_no_link_leads_out_of_a_folder_whose_name_a_command_chooses(tmp_path):
    elsewhere, named = tmp_path / "elsewhere", tmp_path / "named"
    elsewhere.mkdir()
    named.symlink_to(tmp_path)  # what the user names may be a link
    own = register_folder(named / "frames")
    write_text(own / "drive/front/0", "x")
    (own / "drive/back").symlink_to(elsewhere)
    with pytest.raises(ValueError, match="drive/back is a link, and what is written there"):
        write_text(own / "drive/back/0", "x")
    (tmp_path / "other").symlink_to(elsewhere)
    with pytest.raises(ValueError, match="other is a link"):
        register_folder(named / "other")
    require_no_link(named / "a/b", named)
    assert not any(elsewhere.iterdir())


def test_files_of_several_names_never_meet():
    plain = file_names(["a", "b", "c_lonlat"], ("", "_lonlat"))
    assert plain == {"a": "a", "b": "b", "c_lonlat": "c_lonlat"}
    for names, endings in (
        (["x", "X"], ("",)),
        (["\uac00", "\u1100\u1161"], ("",)),  # one letter, composed and in parts
        (["\u8c48", "\uf900"], ("",)),  # one letter with two numbers
        (["a", "a.", "a.."], ("",)),  # Windows drops dots at the end
        (["a", "a_lonlat", "b"], ("", "_lonlat")),
        (["a", "A_lonLat", file_names(["a", "A"])["a"] + "_LONLAT"], ("", "_lonlat")),
    ):
        files = file_names(names, endings)
        assert files.get("b", "b") == "b"
        made = [f"{file}{ending}".casefold() for file in files.values() for ending in endings]
        made = [unicodedata.normalize("NFC", name).rstrip(".") for name in made]
        assert len({*made}) == len(made) == len(names) * len(endings)
