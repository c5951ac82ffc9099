"""Location of the files that are installed with the library: configs, commands, models."""

from pathlib import Path

import gsmap

_MARKER = "models/registry.json"  # a root that has this file has all installed files


def shipped_path(path: str = "") -> Path:
    """Return the path at which a file or folder of the repository is installed.

    A wheel installs these files to ``gsmap/.mim``; an editable installation uses the repository.

    Args:
        path: Path of the file or folder in the repository; the default is the root of all files.

    Returns:
        The path, which is not checked: the file or folder may be missing.

    Raises:
        FileNotFoundError: If the installation is incomplete.
    """
    package = Path(gsmap.__file__).parent
    # In an editable installation, the repository is one of the folders above the package.
    for root in (package / ".mim", *package.parents):
        if (root / _MARKER).is_file():
            return root / path
    raise FileNotFoundError(
        f"{package} is without its configs, commands and models: install GSMap again."
    )
