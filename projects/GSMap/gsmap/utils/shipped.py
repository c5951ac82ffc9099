"""Where the files are that come with the library: configs, commands, trained models."""

from pathlib import Path

import gsmap

_MARK = "models/registry.json"


def shipped(path: str = "") -> Path:
    """Return a file or folder that comes with the library, given its path in the repository.

    A wheel has them in ``gsmap/.mim``; an editable installation reads the repository around it.

    Raises:
        FileNotFoundError: If the installation is not whole.
    """
    package = Path(gsmap.__file__).parent
    for root in (package / ".mim", *package.parents):
        if (root / _MARK).is_file():
            return root / path
    raise FileNotFoundError(
        f"{package} is without its configs, commands and models: install GSMap again."
    )
