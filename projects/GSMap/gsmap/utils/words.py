"""Numbers in sentences and in tables."""

from collections.abc import Iterable, Sequence


def counted(count: int, noun: str) -> str:
    """Return a number with its noun, in the plural unless it is one: ``3 samples``."""
    ending = "es" if noun.endswith("s") else "s"
    return f"{count} {noun}{'' if count == 1 else ending}"


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown, a line per row."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
