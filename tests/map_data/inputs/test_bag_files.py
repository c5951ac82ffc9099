"""How a bag lies on the disk: parts, other encodings beside ROS 2's, and files that are cut."""

import shutil
import sqlite3

import pytest
from bag_cases import START_NS, Recorder, Straight, options
from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags.rosbag1 import Reader as Reader1

from mapdata.bag_files import bag_at
from mapdata.inputs import open_input

PROTOBUF = ("vendor.Health", "protobuf", b"\x0a\x00", "/health", "protobuf")
JSON = ("Health", "jsonschema", b'{"type": "object"}', "/health", "json")
BROKEN = ("vendor_msgs/msg/Odd", "ros2msg", b"uint8[ x = ", "/odd", "cdr")


def bag_of(tmp_path, kind, name="drive", start_ns=START_NS):
    straight = Straight(Recorder(tmp_path / name, kind))
    straight.times_ns = [time_ns - START_NS + start_ns for time_ns in straight.times_ns]
    return straight.write()


def copy_mcap(source, target, profile="ros2", extra=None):
    """Write the messages of an MCAP to another, with one more channel."""
    with source.open("rb") as file, target.open("wb") as out:
        writer = Writer(out)
        writer.start(profile=profile, library="test")
        channels = {}
        for schema, channel, message in make_reader(file).iter_messages():
            if channel.id not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, number, channel.metadata
                )
            time_ns = message.log_time
            writer.add_message(channels[channel.id], time_ns, message.data, time_ns)
        if extra is not None:
            name, encoding, data, topic, message_encoding = extra
            number = writer.register_schema(name, encoding, data)
            channel = writer.register_channel(topic, message_encoding, number)
            writer.add_message(channel, START_NS, b"{}", START_NS)
        writer.finish()


def mcap_of_ros1(bag, target, **settings):
    """Write a bag of ROS 1 as MCAP, as ``mcap convert`` does."""
    with Reader1(bag) as reader, target.open("wb") as file:
        writer = Writer(file, **settings)
        writer.start(profile="ros1", library="test")
        channels = {}
        for connection, time_ns, raw in reader.messages():
            if connection.topic not in channels:
                name = connection.msgtype.replace("/msg/", "/")
                text = connection.msgdef.data.encode()
                schema = writer.register_schema(name, "ros1msg", text)
                channels[connection.topic] = writer.register_channel(
                    connection.topic, "ros1", schema
                )
            writer.add_message(channels[connection.topic], time_ns, bytes(raw), time_ns)
        writer.finish()


@pytest.mark.parametrize(
    ("profile", "extra"),
    [("ros2", PROTOBUF), ("ros2", JSON), ("ros2", BROKEN), ("", None)],
)
@pytest.mark.parametrize("is_folder", [False, True])
def test_an_mcap_of_ros2_with_a_channel_of_another_kind_is_read(
    tmp_path, profile, extra, is_folder
):
    folder = bag_of(tmp_path, "mcap")
    (file,) = folder.glob("*.mcap")
    other = tmp_path / "other.mcap"
    copy_mcap(file, other, profile, extra)
    shutil.copy(other, file)
    source = open_input(folder if is_folder else other, options(tmp_path))
    assert len(source.samples) == 11
    assert source.has_poses
    assert {len(sample.cameras) for sample in source.samples} == {2}


def test_an_mcap_with_nothing_but_another_kind_lists_its_encoding(tmp_path):
    path = tmp_path / "odd.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="", library="test")
        schema = writer.register_schema(*PROTOBUF[:3])
        writer.add_message(writer.register_channel("/health", "protobuf", schema), 1, b"", 1)
        writer.finish()
    with pytest.raises(ValueError, match=r"it holds: /health \(vendor.Health in protobuf, 1\)"):
        open_input(path)


@pytest.mark.parametrize("settings", [{}, {"use_chunking": False}])
def test_an_mcap_of_ros1_is_read(tmp_path, settings):
    mcap_of_ros1(bag_of(tmp_path, "ros1"), tmp_path / "a.mcap", **settings)
    source = open_input(tmp_path / "a.mcap", options(tmp_path))
    assert len(source.samples) == 11
    assert source.samples[10].global_from_frame[0, 3] == pytest.approx(5.0)


@pytest.mark.parametrize(("kind", "suffix"), [("ros1", "bag"), ("sqlite", "db3"), ("mcap", "mcap")])
def test_a_folder_of_parts_is_one_drive_and_of_others_is_refused(tmp_path, kind, suffix):
    folder = tmp_path / "parts"
    folder.mkdir()
    for part in range(2):
        path = bag_of(tmp_path, kind, f"part{part}", START_NS + part * 2 * 10**9)
        (file,) = [path] if kind == "ros1" else path.glob(f"*.{suffix}")
        shutil.copy(file, folder / f"drive_{part}.{suffix}")
    source = open_input(folder, options(tmp_path))
    assert len(source.samples) == 22
    assert f"drive_0.{suffix}, drive_1.{suffix} are read as the parts" in source.notes[0]
    (folder / f"drive_1.{suffix}").rename(folder / f"monday.{suffix}")
    with pytest.raises(ValueError, match=rf"several bags \(.*monday\.{suffix}.*\): name one"):
        open_input(folder, options(tmp_path))
    (folder / f"drive_0.{suffix}").unlink()
    assert len(open_input(folder, options(tmp_path)).samples) == 11


def test_a_part_that_the_metadata_do_not_name_is_named(tmp_path):
    folder = bag_of(tmp_path, "mcap")
    (file,) = folder.glob("*.mcap")
    shutil.copy(file, folder / "drive_1.mcap")
    source = open_input(folder, options(tmp_path))
    assert source.notes[0].startswith("drive_1.mcap in drive are not read, since metadata.yaml")


def test_a_missing_part_is_named(tmp_path):
    folder = bag_of(tmp_path, "mcap")
    (folder / "drive.mcap").rename(tmp_path / "away.mcap")
    expected = r"metadata\.yaml names drive\.mcap, which drive does not contain: copy all"
    with pytest.raises(ValueError, match=expected):
        open_input(folder, options(tmp_path))


@pytest.mark.parametrize("suffix", ["bag", "mcap", "db3"])
def test_a_file_that_is_no_bag_is_named_with_its_first_bytes(tmp_path, suffix):
    path = tmp_path / f"a.{suffix}"
    path.write_text("version https://git-lfs.github.com/spec/v1\nsize 3\n")
    with pytest.raises(ValueError, match=rf"begins with b'version http' and is no \.{suffix} file"):
        open_input(path)


def test_metadata_that_cannot_be_read_are_named(tmp_path):
    folder = bag_of(tmp_path, "sqlite")
    (folder / "metadata.yaml").write_text("")
    with pytest.raises(ValueError, match=r"metadata\.yaml is empty or damaged: `ros2 bag reindex"):
        open_input(folder, options(tmp_path))


@pytest.mark.parametrize(
    ("kind", "suffix", "remedy"),
    [("mcap", "mcap", "mcap recover"), ("sqlite", "db3", "sqlite3"), ("ros1", "bag", "rosbag rei")],
)
@pytest.mark.parametrize("share", [0.0, 0.6])
def test_a_bag_that_is_cut_names_its_cause_and_a_remedy(tmp_path, kind, suffix, remedy, share):
    bag_of(tmp_path, kind)
    (path,) = tmp_path.rglob(f"*.{suffix}")
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * share)])
    message = rf"cannot be used: .*(killed|cut short).*`{remedy}" if share else "it is empty: the"
    with pytest.raises(ValueError, match=message):
        open_input(path, options(tmp_path))


def test_messages_in_a_log_of_sqlite_are_named(tmp_path):
    """A recorder that was killed leaves the last messages beside its file."""
    (file,) = bag_of(tmp_path, "sqlite").glob("*.db3")
    copy = tmp_path / "killed.db3"
    base = sqlite3.connect(file)
    base.execute("PRAGMA journal_mode=WAL")
    base.execute("INSERT INTO messages SELECT id + 9999, topic_id, timestamp, data FROM messages")
    base.commit()
    shutil.copy(file, copy)
    shutil.copy(f"{file}-wal", f"{copy}-wal")
    base.close()
    source = open_input(copy, options(tmp_path))
    assert source.notes[0].startswith("killed.db3-wal holds messages that killed.db3 lacks")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("a.bag.active", "`rosbag reindex a.bag.active`"),
        ("a_0.mcap.zstd", r"it is packed \(.zstd\): unpack it first"),
        ("A.MCAP", "rename it: the suffix of a bag is .mcap"),
        ("a.txt", "is no input: it must be"),
    ],
)
def test_a_file_that_is_nearly_a_bag_says_what_to_do(tmp_path, name, message):
    (tmp_path / name).write_bytes(b"x")
    with pytest.raises(ValueError, match=message):
        open_input(tmp_path / name)


def test_a_topic_whose_type_cannot_be_read_costs_itself_and_is_named(tmp_path):
    folder = bag_of(tmp_path, "sqlite")
    (file,) = folder.glob("*.db3")
    with sqlite3.connect(file) as base:
        base.execute(
            "UPDATE message_definitions SET encoded_message_definition = 'uint8[ x ='"
            "WHERE topic_type = 'tf2_msgs/msg/TFMessage'"
        )
        base.execute("UPDATE topics SET type_description_hash = ''")
    with pytest.raises(
        ValueError, match=r"no transforms at all; /tf_static, /tf cannot be read: Could"
    ):
        open_input(file, options(tmp_path))
    with sqlite3.connect(file) as base:
        base.execute("UPDATE topics SET type = 'tf/msg/tfMessage' WHERE name = '/tf'")
        base.execute(
            "UPDATE message_definitions SET encoded_message_definition = 'uint8[ x =', "
            "topic_type = 'tf/msg/tfMessage' WHERE topic_type = 'tf2_msgs/msg/TFMessage'"
        )
    source = open_input(file, options(tmp_path))
    assert not source.has_poses
    assert len(source.samples) == 11
    assert source.notes[0].startswith("'/tf' is left out: Could not parse")


@pytest.mark.parametrize("kind", ["sqlite", "mcap", "ros1"])
@pytest.mark.parametrize("name", ["a#b", "a?b=c", "a b&c", "a%20b"])
def test_a_folder_may_have_signs_of_addresses_in_its_name(kind, name, tmp_path):
    recorder = Recorder(tmp_path / "drive", kind)
    with recorder:
        recorder.send("/x", "std_msgs/msg/String", 5, data="hello")
    (tmp_path / name).mkdir()
    path = recorder.path.rename(tmp_path / name / recorder.path.name)
    bag = bag_at(path)
    bag.open()
    assert [time_ns for _, time_ns, _ in bag.messages(bag.connections)] == [5]
    bag.close()
