"""Entry point ``gsmap COMMAND ...``, which runs the scripts of ``tools/`` from any folder."""

import ast
import runpy
import sys
from pathlib import Path

from gsmap import __version__
from gsmap.utils.cli import BAD_INPUT, CommandParser
from gsmap.utils.faults import suggestion
from gsmap.utils.shipped import shipped_path


def _summary(tool: Path) -> str:
    """Return the summary of a script, from its docstring, without running the script."""
    source = tool.read_text(encoding="utf-8")
    docstring = ast.get_docstring(ast.parse(source)) or ""
    first_line = docstring.split("\n")[0]
    # The command may follow the summary: "Make annotation files: ``create_data.py ...``."
    return first_line.partition(": ``")[0].rstrip(".")


def _overview(tools: dict[str, Path]) -> str:
    """Return the help text with all commands and their summaries."""
    width = max(map(len, tools))
    lines = ["usage: gsmap [--help | --version] COMMAND ...", ""]
    for name, tool in tools.items():
        lines.append(f"  {name:{width}}  {_summary(tool)}")
    lines += ["", "gsmap COMMAND --help says more.\n"]
    return "\n".join(lines)


def main() -> None:
    """Run the script named by the first argument, like ``python tools/NAME.py``."""
    # `shipped_path` finds the folder in the repository, or in the files of an installed package.
    scripts = sorted(shipped_path("tools").glob("*.py"))
    tools = {path.stem: path for path in scripts}
    name = sys.argv[1] if len(sys.argv) > 1 else "--help"
    if name in ("-h", "--help"):
        sys.stdout.write(_overview(tools))
    elif name == "--version":
        sys.stdout.write(f"gsmap {__version__}\n")
    elif name not in tools:
        # The text "; did you mean ...?" with a similar command. It is empty if none is similar.
        hint = suggestion(name, tools) or f"; there are {', '.join(tools)}."
        sys.stderr.write(f"error: there is no command {name}{hint}\n")
        sys.exit(BAD_INPUT)
    else:
        # The `CommandParser` of the script shows this name in its usage and messages.
        CommandParser.program = f"gsmap {name}"
        # The script must find its path in `sys.argv[0]`, followed by its arguments. So drop the
        # path of ``gsmap``, and replace the name of the command by the path of its script.
        del sys.argv[0]
        sys.argv[0] = str(tools[name])
        # For a script, Python looks for modules in its folder. `run_path` does not add the folder.
        sys.path.insert(0, str(tools[name].parent))
        runpy.run_path(sys.argv[0], run_name="__main__")


if __name__ == "__main__":
    main()
