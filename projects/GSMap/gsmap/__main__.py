"""The commands of ``tools/`` from any folder: ``gsmap train CONFIG``, ``gsmap infer INPUT ...``.

They belong to the repository, which an editable installation (``make setup``) leaves in its place.
"""

import runpy
import sys
from pathlib import Path

from gsmap.utils.cli import BAD_INPUT

TOOLS = Path(__file__).resolve().parents[3] / "tools"


def main() -> None:
    """Run the tool that the first word names, as ``python tools/NAME.py`` does."""
    commands = sorted(path.stem for path in TOOLS.glob("*.py"))
    if not commands:
        sys.exit(f"error: no commands in {TOOLS}: install the repository with pip install -e .")
    name = sys.argv[1] if len(sys.argv) > 1 else "--help"
    if name in ("-h", "--help"):
        lines = ["usage: gsmap COMMAND ...", "", "gsmap COMMAND --help says more:", *commands]
        sys.stdout.write("\n  ".join(lines) + "\n")
    elif name not in commands:
        sys.stderr.write(f"error: there is no command {name}; there are {', '.join(commands)}.\n")
        sys.exit(BAD_INPUT)
    else:
        del sys.argv[0]
        sys.argv[0] = str(TOOLS / f"{name}.py")
        runpy.run_path(sys.argv[0], run_name="__main__")


if __name__ == "__main__":
    main()
