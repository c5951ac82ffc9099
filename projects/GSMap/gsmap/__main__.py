"""The commands of ``tools/`` from any folder: ``gsmap train CONFIG``, ``gsmap infer INPUT ...``."""

import ast
import runpy
import sys
from pathlib import Path

from gsmap import __version__
from gsmap.utils.cli import BAD_INPUT, CommandParser
from gsmap.utils.faults import nearest
from gsmap.utils.shipped import shipped


def _summary(tool: Path) -> str:
    """Return the first line of a tool's docstring, without running it."""
    text = ast.get_docstring(ast.parse(tool.read_text(encoding="utf-8"))) or ""
    return text.split("\n")[0].partition(": ``")[0].rstrip(".")


def _overview(tools: dict[str, Path]) -> str:
    """Return the list of all commands."""
    width = max(map(len, tools))
    lines = [f"  {name:{width}}  {_summary(tool)}" for name, tool in tools.items()]
    usage = "usage: gsmap [--help | --version] COMMAND ..."
    return "\n".join([usage, "", *lines, "", "gsmap COMMAND --help says more.\n"])


def main() -> None:
    """Run the tool that the first word names, as ``python tools/NAME.py`` does."""
    tools = {path.stem: path for path in sorted(shipped("tools").glob("*.py"))}
    name = sys.argv[1] if len(sys.argv) > 1 else "--help"
    if name in ("-h", "--help"):
        sys.stdout.write(_overview(tools))
    elif name == "--version":
        sys.stdout.write(f"gsmap {__version__}\n")
    elif name not in tools:
        hint = nearest(name, tools) or f"; there are {', '.join(tools)}."
        sys.stderr.write(f"error: there is no command {name}{hint}\n")
        sys.exit(BAD_INPUT)
    else:
        CommandParser.program = f"gsmap {name}"
        del sys.argv[0]
        sys.argv[0] = str(tools[name])
        sys.path.insert(0, str(tools[name].parent))  # as Python does for a script
        runpy.run_path(sys.argv[0], run_name="__main__")


if __name__ == "__main__":
    main()
