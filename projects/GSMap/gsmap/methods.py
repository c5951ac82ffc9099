"""The methods of the library: the one list that everything else reads.

A method is whole in ``gsmap/models/<name>``: its parts, its targets, the table of its state keys
(``keys.py``) and its paper's numbers (``paper.json``). Beside it are only ``configs/<name>``,
``tests/methods/<name>``, ``docs/methods/<name>.md`` and ``docs/methods/names/<name>.md``.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsmap.utils.files import read_json


@dataclass(frozen=True)
class Method:
    """A method.

    Attributes:
        name: Name of its folders and of its page.
        title: Its name as its authors write it.
        built_on: Names of the methods whose parts, key tables or configs it uses, all of them.
    """

    name: str
    title: str
    built_on: tuple[str, ...] = ()

    @property
    def folder(self) -> Path:
        """Its folder in ``gsmap/models``."""
        return Path(__file__).parent / "models" / self.name

    def paper(self) -> dict[str, Any]:
        """Return the numbers of its paper and release, from ``paper.json``.

        Returns:
            ``arxiv``, the paper's number; ``parameters``, trainable ones by config; ``settings``,
            published values by config and path; ``heads``, by config the queries of each group,
            weights of losses and auxiliary heads by name, weights of costs in order; ``tables``,
            as ``configs/tables.json`` has those of several methods.
        """
        return read_json(self.folder / "paper.json")


METHODS = (
    Method("gsmap", "GSMap", built_on=("maptr",)),
    Method("maptr", "MapTR"),
    Method("maptrv2", "MapTRv2", built_on=("maptr",)),
    Method("mapvr", "MapVR", built_on=("maptr", "maptrv2")),
    Method("gemap", "GeMap", built_on=("maptr", "maptrv2")),
    Method("mgmapnet", "MGMapNet", built_on=("maptr", "maptrv2")),
    Method("mapqr", "MapQR", built_on=("maptr", "maptrv2")),
    Method("mgmap", "MGMap", built_on=("maptr",)),
    Method("pivotnet", "PivotNet"),
    Method("hdmapnet", "HDMapNet"),
    Method("vectormapnet", "VectorMapNet"),
    Method("bemapnet", "BeMapNet"),
    Method("streammapnet", "StreamMapNet", built_on=("maptr",)),
)
