"""Write the tables of docs/methods.md from the ``paper.json`` of each method.

python docs/method_tables.py
"""

import re
from collections.abc import Iterable
from pathlib import Path

from gsmap.methods import METHODS, Method

DOCS = Path(__file__).resolve().parent
PAGE = DOCS / "methods.md"


def overview_table() -> str:
    """Table of the methods: the paper, the elements, the parts, and the number of parameters."""
    header = (
        "method",
        "an element is",
        "it adds to MapTR",
        "trainable parameters (R50 by default)",
    )
    return _table(header, [_overview_row(method) for method in METHODS])


def _overview_row(method: Method) -> tuple[str, ...]:
    """Row of a method in the first table.

    The entries ``source`` (equations of the paper), ``page`` (address of the documentation) and
    ``parameters_note`` of the overview are optional.
    """
    paper = method.paper()
    overview = paper["overview"]
    source = f", {overview['source']}" if "source" in overview else ""
    arxiv = f"[{paper['arxiv']}](https://arxiv.org/abs/{paper['arxiv']})"
    page = overview.get("page", f"methods/{method.name}.md")
    counts = [f"{count:,}" for count in paper["parameters"].values()]  # one for each config
    if len(counts) > 1:  # the name of its config is put before each number
        counts = [
            f"`{Path(config).stem}` {count}"
            for config, count in zip(paper["parameters"], counts, strict=True)
        ]
    note = f" ({overview['parameters_note']})" if "parameters_note" in overview else ""
    return (
        f"{method.title}, {arxiv}{source} ([page]({page}))",
        overview["element"],
        overview["adds"],
        ", ".join(counts) + note,
    )


def precision_table() -> str:
    """Table of the published AP_chamfer / AP_raster on nuScenes after 24 and after 110 epochs."""
    rows = []
    for method in METHODS:
        # Two texts, one for each number of epochs. Methods without published figures have no row.
        figures = method.paper()["overview"].get("average_precision")
        if figures:
            rows.append((method.title, *figures))
    return _table(("method", "24 epochs", "110 epochs"), rows)


def _table(header: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    """Table in Markdown."""
    lines = [header, ("---",) * len(header), *rows]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def with_tables(text: str) -> str:
    """Replace the tables in the text of the page, each between its two markers.

    Raises:
        ValueError: If the markers of a table are missing or occur several times.
    """
    for name, table in (("overview", overview_table()), ("precision", precision_table())):
        start = f"<!-- {name}: docs/method_tables.py -->\n"
        end = f"<!-- end of {name} -->\n"
        pattern = re.compile(f"{re.escape(start)}.*?{re.escape(end)}", re.DOTALL)
        # A function returns the new block, because `subn` would interpret backslashes in a text.
        text, num_replaced = pattern.subn(lambda _, block=start + table + end: block, text)
        if num_replaced != 1:
            raise ValueError(
                f"{PAGE} needs one pair of the markers {start.strip()} ... {end.strip()}."
            )
    return text


if __name__ == "__main__":
    PAGE.write_text(with_tables(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
