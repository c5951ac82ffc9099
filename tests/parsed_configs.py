"""Configs in tests: a process parses each once, and does not format the ones that it writes."""

import pickle
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from mmengine.config import Config
from mmengine.config import config as config_module

REPO = Path(__file__).resolve().parents[1]
FOLDERS = (REPO / "configs", REPO / "projects/GSMap/configs")


def keep_parsed_configs() -> None:
    """Let mmengine parse each config of the repository once, and copy the values for each use.

    The tests read some hundred configs many times, and most of them share their bases. No test
    writes to the folders of the configs; files elsewhere are parsed each time.
    """
    Config._file2dict = staticmethod(_copy_if_parsed(Config._file2dict))


def leave_configs_unformatted() -> None:
    """Let mmengine write configs without the line breaks of yapf.

    A training writes its config four times, and yapf takes half a second for each. The values stay
    equal. Commands in processes of their own format as always.
    """
    config_module.FormatCode = _keep_text


def _keep_text(text: str, **_: object) -> tuple[str, bool]:
    """Stand for ``FormatCode`` of yapf, and change nothing."""
    return text, False


def _copy_if_parsed(parse: Callable[..., tuple]) -> Callable[..., tuple]:
    """Return a function that parses a file of the repository once.

    Args:
        parse: Function of mmengine that parses a file and, by ``Config._file2dict``, its bases.
    """

    @cache
    def parse_once(filename: str, options: tuple[tuple[str, Any], ...]) -> bytes:
        return pickle.dumps(parse(filename, **dict(options)))

    def parse_or_copy(
        filename: str,
        use_predefined_variables: bool = True,
        use_environment_variables: bool = True,
        lazy_import: bool | None = None,
    ) -> tuple:
        options = {
            "use_predefined_variables": use_predefined_variables,
            "use_environment_variables": use_environment_variables,
            "lazy_import": lazy_import,
        }
        path = Path(filename).resolve()
        if path.is_file() and any(path.is_relative_to(folder) for folder in FOLDERS):
            return pickle.loads(parse_once(str(path), tuple(options.items())))
        return parse(filename, **options)

    return parse_or_copy
