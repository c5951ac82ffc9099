"""Formatting of counts and tables."""

from collections.abc import Iterable, Sequence


def format_count(count: int, noun: str) -> str:
    """Format a number with its noun, in the plural unless the number is 1: ``3 samples``."""
    if count == 1:
        return f"{count} {noun}"
    ending = "es" if noun.endswith("s") else "s"
    return f"{count} {noun}{ending}"


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Format a Markdown table.

    Args:
        head: Titles of the columns.
        rows: Cells of each row.
    """
    rule = ["---"] * len(head)
    lines = []
    for cells in (head, rule, *rows):
        escaped = [cell.replace("|", r"\|") for cell in cells]  # names may contain the separator
        lines.append(f"| {' | '.join(escaped)} |")
    return "\n".join(lines)
