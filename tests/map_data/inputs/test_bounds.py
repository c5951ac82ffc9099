"""Small files take bounded memory and time: recordings, calibrations and info files."""

import bz2
import pickle
import struct
from importlib import import_module
from io import BytesIO
from shutil import copyfileobj

import numpy as np
import pytest
from backports import zstd
from bag_cases import options
from lz4 import frame as lz4
from mcap.writer import CompressionType, Writer

from mapdata import decompression
from mapdata.folders.calibration_file import _read_values
from mapdata.folders.images import _simplify_pattern
from mapdata.infos.plain_pickle import load_plain_pickle
from mapdata.inputs import open_input
from mapdata.ros_bag import RosTypes

FREE, LARGE = 10**6, 5 * 10**6  # in place of FREE_BYTES, and what packed zeros become
IMAGE = "string format\nuint8[] data\n"
PART = "=" * 80 + "\nMSG: "


@pytest.fixture(autouse=True)
def less_is_free(monkeypatch):
    monkeypatch.setattr(decompression, "FREE_BYTES", FREE)


def nested(count: int, last: str) -> str:
    """Types with a thousand of the next each."""
    parts = [f"{PART}a/A{i}\na/A{i + 1}[1000] x\n" for i in range(count)]
    return "".join(["a/A0[1000] x\n", *parts, f"{PART}a/A{count}\n{last}"])


@pytest.mark.parametrize(
    ("definition", "message"),
    [
        ("string[3000000] data\n", "more than 10000 fields"),
        (f"a/Point[3000000] data\n{PART}a/Point\nfloat64 x\n", "more than 10000 fields"),
        ("".join(f"uint8 a{i}\n" for i in range(10_001)), "definition has .* letters"),
        ("string[5000] a\nstring[5001] b\n", "more than 10000 fields"),
        (nested(3, "uint8 x\n"), "more than 10000 fields"),
        (nested(3, ""), "an array of values without any field"),
        (f"a/Nothing[] x\n{PART}a/Nothing\n", "an array of values without any field"),
        ("#" * 100_001, "definition has 100001 letters, more than 100000"),
    ],
)
def test_types_that_take_long_to_make_are_refused(definition, message):
    with pytest.raises(ValueError, match=message):
        RosTypes().parser("a/msg/Image", definition, is_idl=False, is_ros1=False)


def test_numbers_of_any_length_are_read_and_the_types_of_a_bag_counted_together():
    types = RosTypes()
    for number in range(2):
        fields = "".join(f"float64[3000000] a{i}\n" for i in range(3500))
        assert types.parser(f"a/msg/T{number}", fields, is_idl=False, is_ros1=False)
    with pytest.raises(ValueError, match="more than 10000 fields"):
        types.parser("a/msg/Last", f"{fields}float64 b\n", is_idl=False, is_ros1=False)


def mcap_of(path, content, kind, profile="ros2"):
    """An MCAP with one chunk of content that is packed."""
    text = lambda words: struct.pack("<I", len(words)) + words.encode()  # noqa: E731
    record = lambda code, b: bytes([code]) + struct.pack("<Q", len(b)) + b  # noqa: E731
    packed = lz4.compress(content) if kind == "lz4" else zstd.compress(content)
    chunk = struct.pack("<QQQI", 0, 9, len(content), 0) + text(kind)
    chunk += struct.pack("<Q", len(packed)) + packed
    parts = [record(1, text(profile) + text("x")), record(6, chunk), record(15, bytes(4))]
    magic = b"\x89MCAP0\r\n"
    path.write_bytes(magic + b"".join(parts) + record(2, bytes(20)) + magic)


@pytest.mark.parametrize("profile", ["ros2", ""])  # rosbags, and mcap's own reader
@pytest.mark.parametrize("kind", ["zstd", "lz4"])
def test_a_chunk_that_unpacks_to_far_more_is_refused(kind, profile, tmp_path):
    mcap_of(tmp_path / "a.mcap", bytes(LARGE), kind, profile)
    with pytest.raises(ValueError, match=r"more than 100 times as large.*--compression none"):
        open_input(tmp_path / "a.mcap", options(tmp_path))


def test_every_way_of_packing_is_bounded_and_gives_its_content():
    content = bytes(range(256)) * 1000
    decompression.import_bounded("rosbags.rosbag1")
    reader1 = import_module("rosbags.rosbag1.reader")
    decompression.import_bounded("rosbags.rosbag2")
    decompression.import_bounded("mcap.reader")
    storage = import_module("rosbags.rosbag2.storage_mcap")
    stream = import_module("mcap.stream_reader")
    ways = {
        bz2.compress: [reader1.decompressors["bz2"]],
        lz4.compress: [
            reader1.decompressors["lz4"], stream.lz4.decompress,
            lambda data: storage.DECOMPRESSORS["lz4"](data, 0),
        ],
        zstd.compress: [
            storage.DECOMPRESSORS["zstd"], stream.zstandard.decompress,
            import_module("rosbags.rosbag2.reader").zstd.decompress,
        ],
    }  # fmt: skip
    zeros = bytes(LARGE)
    for compress, functions in ways.items():
        small, large = compress(content), compress(zeros)
        for unpack in functions:
            decompression.begin_bag()
            assert unpack(small) == content
            with pytest.raises(ValueError, match="more than 100 times as large"):
                unpack(large)


def test_a_packed_file_is_unpacked_no_farther(tmp_path):
    decompression.import_bounded("rosbags.rosbag2")
    decompression.begin_bag()
    (tmp_path / "a.zstd").write_bytes(zstd.compress(bytes(LARGE)))
    opened = import_module("rosbags.rosbag2.reader").zstd.open
    with (
        (tmp_path / "a.zstd").open("rb") as file,
        opened(file, "rb") as unpacked,
        pytest.raises(ValueError, match="more than 100 times as large"),
    ):
        copyfileobj(unpacked, BytesIO())


def test_recordings_that_pack_well_are_read(tmp_path):
    """Chunks of 5 MB in all, each of which becomes 90 times as large."""
    decompression.begin_bag()
    noise = np.random.default_rng(0).bytes(700)
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD, chunk_size=1)
        writer.start(profile="", library="x")
        schema = writer.register_schema(name="a", encoding="x", data=b"")
        channel = writer.register_channel(topic="/a", message_encoding="x", schema_id=schema)
        for time_ns in range(80):
            writer.add_message(channel, time_ns, noise + bytes(len(noise) * 90), time_ns)
        writer.finish()
    with path.open("rb") as file:
        messages = decompression.import_bounded("mcap.reader").make_reader(file).iter_messages()
        assert sum(len(message.data) for *_, message in messages) == 80 * 91 * 700


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x: &a [1]\ny: [*a, *a]\n", "has aliases of YAML"),
        ("x: &a {b: 1}\ny:\n  <<: [*a, *a]\n", "has aliases of YAML"),
        ("x: [" + "1," * 200_000 + "1]\n", "more than 300000 bytes"),
    ],
)
def test_metadata_that_stand_for_more_are_refused(text, message, tmp_path):
    (tmp_path / "metadata.yaml").write_text(text)
    (tmp_path / "a_0.db3").write_bytes(b"SQLite format 3\0")
    with pytest.raises(ValueError, match=message):
        open_input(tmp_path, options(tmp_path))


def test_a_calibration_of_a_megabyte_is_refused(tmp_path):
    (tmp_path / "c.yaml").write_text("cameras: [" + "1," * 200_000 + "1]\n")
    with pytest.raises(ValueError, match="more than 300000 bytes"):
        _read_values(tmp_path / "c.yaml")


def test_a_pattern_of_any_folders_is_looked_for_once():
    assert _simplify_pattern("**/" * 12 + "a*.png") == "**/a*.png"
    assert _simplify_pattern("a/**/b/**/*.png") == "a/**/b/**/*.png"
    with pytest.raises(ValueError, match=r"more than 2 `\*\*`"):
        _simplify_pattern("**/a/**/b/**/*.png")


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ([i * (2**61 - 1) for i in range(3)], "more than 60 bits"),
        ([(0, 2**61 - 1)], "more than 60 bits"),
        ([(1.5, 2.5)], "a tuple with a floating-point number"),
        ([(-1,) * 9], "a key has 9 parts"),
    ],
)
def test_keys_that_may_share_a_hash_are_refused(keys, message, tmp_path):
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(dict.fromkeys(keys)))
    with pytest.raises(ValueError, match=message):
        load_plain_pickle(tmp_path / "a.pkl")


def test_keys_of_info_files_are_read(tmp_path):
    values = {"a": 1, 2: 3, 2.5: 4, (1, "b"): 5, 10**18: 6}
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(values))
    assert load_plain_pickle(tmp_path / "a.pkl") == values
