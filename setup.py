"""Build step that adds configs, commands and trained models to the wheel, as ``gsmap/.mim``.

All other settings of the build are in pyproject.toml.

An editable installation reads the repository itself (`gsmap.utils.shipped`).
"""

import json
import shutil
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

PATTERNS = (
    "configs/**/*.py",
    "configs/*.json",
    "projects/GSMap/configs/*.py",
    "tools/**/*.py",
    "tools/*.sh",
    "models/registry.json",
    "models/README.md",
)


def shipped_files() -> list[str]:
    """Return the paths of configs, commands and trained models, relative to the repository."""
    # Weights of models without an address are in the repository. All others are downloaded later.
    models = json.loads(Path("models/registry.json").read_text(encoding="utf-8"))
    weights = [f"models/{model['name']}.pth" for model in models if model["address"] is None]
    files = []
    for pattern in PATTERNS:
        files += [str(path) for path in sorted(Path().glob(pattern))]
    return files + weights


class BuildPackage(build_py):
    """Build command that copies the modules and the files of `shipped_files`."""

    def run(self) -> None:
        """Build the package without files of an earlier build.

        Setuptools would keep an earlier build, and files that were deleted since would get into the
        wheel. An editable installation needs no copies.
        """
        package = Path(self.build_lib, "gsmap")
        if package.is_dir() and not self.editable_mode:
            shutil.rmtree(package)
        super().run()
        if self.editable_mode:
            return
        for file in shipped_files():
            target = package / ".mim" / file
            self.mkpath(str(target.parent))
            self.copy_file(file, str(target))

    def get_source_files(self) -> list[str]:
        """Return the files of a source distribution."""
        return [*super().get_source_files(), *shipped_files()]


setup(cmdclass={"build_py": BuildPackage})
