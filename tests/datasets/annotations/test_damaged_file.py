"""Annotation files that are damaged, or overwritten while they are read."""

import os
import pickle
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from sample_cases import META, assert_same, sample

from gsmap.datasets.annotations.file import AnnotationFile, write_annotations
from gsmap.datasets.annotations.schema import FIELDS


def arrow(path: Path, change) -> None:
    """Rewrite a file's only batch without its seal, changed."""
    batch = pa.ipc.open_file(str(path)).get_batch(0)
    columns = {name: batch.column(name) for name in batch.schema.names}
    changed = pa.record_batch(list(change(columns).values()), schema=batch.schema)
    with pa.OSFile(str(path), "wb") as sink, pa.ipc.new_file(sink, batch.schema) as writer:
        writer.write_batch(changed)


def test_a_file_without_a_checksum_is_read_and_says_so(tmp_path: Path):
    path = tmp_path / "a.arrow"
    write_annotations(path, META, [sample(1)])
    assert AnnotationFile(path).sealed
    arrow(path, lambda columns: columns)
    file = AnnotationFile(path)
    assert not file.sealed
    assert_same(file[0], sample(1))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"token": pa.array([None], pa.string())}, "token is missing"),
        ({"cameras": pa.nulls(1, FIELDS["cameras"])}, "cameras is missing"),
        ({"ego_from_frame": pa.array([[1.0] * 16], pa.list_(pa.float64(), 16))}, "no rigid"),
        (
            {"instances": pa.array([[{"label": 3, "points": [0, 0, 1, 1]}]], FIELDS["instances"])},
            "'token1': label 3 is none of the classes",
        ),
        (
            {"instances": pa.array([[{"label": 0, "points": [0, 0, 1]}]], FIELDS["instances"])},
            r"points of an element must be \(n >= 2, 2\)",
        ),
        (
            {"instances": pa.array([[{"label": 0, "points": None}]], FIELDS["instances"])},
            "points is missing",
        ),
    ],
)
def test_wrong_values_are_refused_on_opening(tmp_path: Path, changes: dict, message: str):
    path = tmp_path / "a.arrow"
    write_annotations(path, META, [sample(1)])
    arrow(path, lambda columns: columns | changes)
    with pytest.raises(ValueError, match=f"a.arrow is damaged: .*{message}.*`make it`"):
        AnnotationFile(path)


def test_every_damaged_byte_is_noticed_or_of_no_effect(tmp_path: Path):
    path = tmp_path / "a.arrow"
    write_annotations(path, META, [sample(i) for i in range(3)])
    content, noticed = path.read_bytes(), 0
    rng = np.random.default_rng(0)
    for place in rng.integers(0, len(content), 120).tolist():
        damaged = bytearray(content)
        damaged[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        try:
            file = AnnotationFile(path)
        except ValueError:
            noticed += 1
            continue
        assert file.sealed
        for number, found in enumerate(file):
            assert_same(found, sample(number))
    assert noticed > 60  # the others hit the footer, which nothing is read from


def test_swapped_blocks_are_noticed(tmp_path: Path):
    path = tmp_path / "a.arrow"
    write_annotations(path, META, [sample(i) for i in range(300)])
    content = bytearray(path.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 4096], content[8192:12288] = (
        content[8192:12288],
        content[middle : middle + 4096],
    )
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"checksum|not a whole"):
        AnnotationFile(path)


def overwrite(path: Path, at: int) -> None:
    """Write noise into a file in place, as a copy over it does."""
    with path.open("r+b") as file:
        file.seek(at)
        file.write(b"\x55" * 64)
    os.utime(path, ns=(1, 1))  # a clock of coarse ticks may give the time that it had


@pytest.mark.parametrize("sealed", [True, False])
def test_a_file_that_shrinks_or_grows_in_use_is_named(sealed: bool, tmp_path: Path):
    """Memory behind the end of a mapped file must not be touched: that ends the process."""
    path = tmp_path / "a.arrow"
    write_annotations(path, META, [sample(i) for i in range(100)])
    if not sealed:
        arrow(path, lambda columns: columns)
    for size in (4096, path.stat().st_size + 1):
        content = path.read_bytes()
        file = AnnotationFile(path)
        worker = pickle.loads(pickle.dumps(file))
        os.truncate(path, size)
        reads = (file.instance_counts, lambda f=file: f[99], lambda f=worker: f[99])
        for read in reads:
            with pytest.raises(ValueError, match=r"a.arrow was changed while .* `make it`"):
                read()
        path.write_bytes(content)


def test_parts_overwritten_in_use_are_noticed_when_they_are_read(tmp_path: Path):
    path = tmp_path / "a.arrow"
    write_annotations(path, META, [sample(i) for i in range(600)])
    file = AnnotationFile(path)
    assert_same(file[599], sample(599))
    worker = pickle.loads(pickle.dumps(file))
    overwrite(path, path.stat().st_size // 2)
    for reader in (file, worker):
        for number in (0, 255, 512, 599):
            assert_same(reader[number], sample(number))
        for number in (256, 511, -300):
            with pytest.raises(ValueError, match="was changed while it was in use"):
                reader[number]
        with pytest.raises(ValueError, match="was changed while it was in use"):
            reader.column("token")


def test_a_new_time_alone_or_the_same_file_again_is_no_change(tmp_path: Path):
    path = tmp_path / "a.arrow"
    write_annotations(path, META, [sample(i) for i in range(3)])
    file = AnnotationFile(path)
    os.utime(path, ns=(1, 1))
    assert_same(file[2], sample(2))
    write_annotations(path, META, [sample(i) for i in range(3)])
    assert_same(pickle.loads(pickle.dumps(file))[2], sample(2))


def test_a_worker_of_a_run_refuses_another_file_of_the_same_name(tmp_path: Path):
    path = tmp_path / "a.arrow"
    write_annotations(path, META, [sample(i) for i in range(3)])
    handed_on = pickle.dumps(AnnotationFile(path))
    write_annotations(path, META, [sample(i) for i in range(4)])
    with pytest.raises(ValueError, match="was replaced after this run had opened it"):
        pickle.loads(handed_on)
    write_annotations(path, META, [sample(i, map_name="city") for i in range(3)])  # as long
    with pytest.raises(ValueError, match="was changed while it was in use"):
        pickle.loads(handed_on)[0]
