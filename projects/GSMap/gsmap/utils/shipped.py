"""Location of the files that are installed with the library: configs, commands, models."""

from pathlib import Path

import gsmap

_MARKER = "models/registry.json"


def shipped_path(path: str = "") -> Path:
    """Return the path at which a file or folder of the repository is installed.

    A wheel installs these files to ``gsmap/.mim``; an editable installation uses the repository.

    Args:
        path: Path of the file or folder in the repository.

    Raises:
        FileNotFoundError: If the installation is incomplete.
    """
    package = Path(gsmap.__file__).parent
    for root in (package / ".mim", *package.parents):
        if (root / _MARKER).is_file():
            return root / path
    raise FileNotFoundError(
        f"{package} is without its configs, commands and models: install GSMap again."
    )
