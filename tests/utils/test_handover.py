"""A batch that a worker cannot hand over is an error, and not waited for."""

import pytest
from processes import run_python

PROGRAM = """
import resource
import sys

import torch
from torch.utils.data import DataLoader, Dataset

from gsmap.utils.cli import run_command


class Ones(Dataset):
    def __len__(self):
        return 3

    def __getitem__(self, row):
        return {"row": row, "values": torch.ones(100_000)}


def main():
    name, limit = sys.argv[1], int(sys.argv[2])
    if limit:
        resource.setrlimit(getattr(resource, name), (limit, limit))
    loader = DataLoader(Ones(), num_workers=1, collate_fn=lambda items: items)
    print(len([batch for batch in loader]), "batches")


run_command(main)
"""


@pytest.mark.parametrize(
    ("limit", "size", "end"),
    [
        ("RLIMIT_FSIZE", 0, None),
        ("RLIMIT_FSIZE", 10_000, "a worker could not hand over what it read (unable to resize"),
        ("RLIMIT_NOFILE", 12, "open files"),
    ],
)
def test_a_worker_that_cannot_hand_over_its_batch_ends_the_command(limit, size, end, tmp_path):
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    done = run_python(program, limit, size)
    if end is None:
        assert (done.returncode, done.stdout) == (0, "3 batches\n"), done.stderr
        return
    assert done.returncode == 2, done.stderr
    last = done.stderr.splitlines()[-1]
    assert last.startswith("error: ")
    assert end in last
    assert "ulimit -n" in last or "num_workers" in last
