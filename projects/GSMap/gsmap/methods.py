"""List of the methods in the library.

The folder ``gsmap/models/<name>`` has all code of a method: modules, targets, the table of state
keys (``keys.py``) and the numbers of the paper (``paper.json``). Other files of a method are in
``configs/<name>``, ``tests/methods/<name>``, ``docs/methods/<name>.md`` and
``docs/methods/names/<name>.md``.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsmap.utils.files import read_json


@dataclass(frozen=True)
class Method:
    """Method for map construction.

    Attributes:
        name: Name of the folders and of the documentation page.
        title: Name in the spelling of the authors.
        built_on: Names of all methods whose modules, key tables or configs the method uses.
    """

    name: str
    title: str
    built_on: tuple[str, ...] = ()

    @property
    def folder(self) -> Path:
        """Folder of the method in ``gsmap/models``."""
        return Path(__file__).parent / "models" / self.name

    def paper(self) -> dict[str, Any]:
        """Read the numbers of the paper and of the authors' code from ``paper.json``.

        Returns:
            Dictionary with these entries:

            - ``arxiv``: Number of the paper at arXiv.
            - ``overview``: Row of the method in ``docs/methods.md``, which
              ``python docs/method_tables.py`` writes.
            - ``parameters``: Number of trainable parameters of each config.
            - ``settings``: Published values, by config and then by the dotted path of the setting
              in the config.
            - ``heads``: Published parts of each config's head: the number of queries of each
              group, the weights of the losses and auxiliary heads by name, and the weights of the
              matching costs in the order of the config.
            - ``tables``: Tables that ``compare.py --list`` prints, each with its name, columns and
              rows.
            - ``shared_tables``, optional: Configs by the name of the model, for each table of
              ``configs/tables.json`` that has rows of this method.
            - ``upstream``, optional: Settings of ``convert_config.py``. ``models`` lists the types
              of the authors' detectors. ``configs`` lists our configs, each with its BEV
              ``encoder`` and ``data_set``. A config with the entry ``depth`` is only for samples
              with depth maps (true) or without them (false).
        """
        return read_json(self.folder / "paper.json")


# Arguments: name, title, and the other methods that this one builds on. The documentation lists the
# methods in this order.
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
    Method("hrmapnet", "HRMapNet", built_on=("maptr", "maptrv2")),
    Method("streammapnet", "StreamMapNet", built_on=("maptr",)),
)
