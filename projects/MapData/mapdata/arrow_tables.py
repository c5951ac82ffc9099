"""Tables of Arrow and Feather files of other programs."""

from pathlib import Path
from typing import Any

from pyarrow import feather

from gsmap.utils.inputs import check_input


def read_table(path: Path, columns: list[str] | None = None, memory_map: bool = False) -> Any:
    """Read a table, and validate it, because a damaged one could crash the process later.

    Args:
        path: Feather file, or Arrow file in IPC format.
        columns: Names of the columns to read; None for all.
        memory_map: Whether large columns stay on the disk until they are used.

    Raises:
        ArrowException: If the table is damaged, or a column is missing.
    """
    check_input(path)  # because Arrow does not open files through Python
    table = feather.read_table(path, columns=columns, memory_map=memory_map)
    table.validate(full=True)
    return table
