"""Packs what comes with the library into a wheel as ``gsmap/.mim``; pyproject.toml has all else.

An editable installation reads the repository itself (`gsmap.utils.shipped`).
"""

import json
import shutil
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

PATTERNS = (
    *("configs/**/*.py", "configs/*.json", "projects/GSMap/configs/*.py"),
    *("tools/**/*.py", "tools/*.sh", "models/registry.json", "models/README.md"),
)


def shipped_files() -> list[str]:
    """Return configs, commands and trained models, relative to the repository."""
    models = json.loads(Path("models/registry.json").read_text(encoding="utf-8"))
    weights = [f"models/{model['name']}.pth" for model in models if model["address"] is None]
    return [str(path) for pattern in PATTERNS for path in sorted(Path().glob(pattern))] + weights


class BuildPackage(build_py):
    """Copies the modules, and what comes with them."""

    def run(self) -> None:
        """Build without what an earlier build left; an editable installation needs no copies."""
        package = Path(self.build_lib, "gsmap")
        if package.is_dir() and not self.editable_mode:
            shutil.rmtree(package)
        super().run()
        for file in [] if self.editable_mode else shipped_files():
            target = package / ".mim" / file
            self.mkpath(str(target.parent))
            self.copy_file(file, str(target))

    def get_source_files(self) -> list[str]:
        """Return what a source distribution needs."""
        return [*super().get_source_files(), *shipped_files()]


setup(cmdclass={"build_py": BuildPackage})
