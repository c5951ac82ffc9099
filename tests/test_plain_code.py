"""Code reads plainly in every room: one statement one thing, described and named arguments."""

from pathlib import Path

import pytest
from readability import Counts, Reader, count, percentage

REPO = Path(__file__).resolve().parents[1]
PACKAGES = [
    REPO / "projects/GSMap/gsmap",
    REPO / "projects/MapData/mapdata",
    REPO / "projects/DriveMaps/drivemaps",
    REPO / "projects/MiniCity/minicity",
]
SMALL = 100  # lines; smaller folders count with their parent alone


def num_lines(folder: Path) -> int:
    """Number of lines of all modules of a folder."""
    return sum(path.read_bytes().count(b"\n") for path in folder.rglob("*.py"))


def rooms() -> list[Path]:
    """Packages and their folders, the folder of each method, commands and benchmarks."""
    folders = [REPO / "tools", REPO / "benchmarks"]
    for package in PACKAGES:
        modules = [package / "__init__.py", *package.glob("*/__init__.py")]
        modules += package.glob("models/*/__init__.py")
        folders += [module.parent for module in sorted(modules)]
    large = [folder for folder in folders if num_lines(folder) >= SMALL]
    assert len(large) > 20
    return large


@pytest.mark.parametrize("room", rooms(), ids=lambda room: str(room.relative_to(REPO)))
def test_a_room_reads_plainly(room):
    counts = count(room)
    thousands = counts.lines / 1000
    assert counts.pairs <= 4 * thousands
    assert counts.splats <= 4 * thousands
    assert counts.comprehensions <= 25 * thousands
    assert percentage(counts.named_arguments, counts.arguments) >= 17
    assert counts.described_functions >= 0.95 * counts.wide_functions
    assert percentage(counts.clauses, counts.docstrings) <= 1
    assert percentage(counts.participles, counts.functions) <= 1


def read(text: str) -> Counts:
    counts = Counts()
    Reader(text, counts)
    return counts


def test_dense_statements_are_counted():
    counts = read(
        '''
"""A module."""

# a comment
a, b = 1, 2
a, b = pair
f(*values, 3, key=4, **more)
[x for x in (y for y in z)]
'''
    )
    assert counts == Counts(
        lines=4, pairs=1, splats=1, comprehensions=2, arguments=4, named_arguments=1
    )


def test_names_and_docstrings_are_counted():
    counts = read(
        '''
class Head:
    """What a layer says of lines."""

    def moved(self, points, offsets, scale):
        """Move points.

        Args:
            points: Points in metres, or what is one. (N, 2)
        """

        def drawn(a, b, c):
            return a

    def read(self, path, mode, encoding):
        """Text of those of the files."""

    def _private(self, a, b, c): ...

    def seed(self, a, b): ...


class _Private:
    def method(self, a, b, c): ...
'''
    )
    assert (counts.functions, counts.participles) == (6, 2)
    assert (counts.wide_functions, counts.described_functions) == (2, 1)
    assert (counts.docstrings, counts.clauses) == (3, 2)
