"""Numbers in sentences."""


def counted(count: int, noun: str) -> str:
    """Return a number with its noun, in the plural unless it is one: ``3 samples``."""
    ending = "es" if noun.endswith("s") else "s"
    return f"{count} {noun}{'' if count == 1 else ending}"
