"""What was being built where an error came up: noted on the error, for `utils.faults`."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from mmengine.config import Config
from mmengine.registry import Registry

_BUILD = Registry.build


@contextmanager
def building(cfg: Config, kind: type | None = None) -> Iterator[None]:
    """Let errors in the block know their config, and the parts that were being built of it.

    An error has ``config``, the name of the file, and ``built``, pairs of a registry and a class,
    the innermost first. ``kind`` is a class that the block makes of settings without a registry.
    """
    before, Registry.build = Registry.build, _build
    try:
        yield
    except Exception as error:
        _note(error, None, kind)
        error.config = cfg.filename  # type: ignore[attr-defined]
        raise
    finally:
        Registry.build = before


def _build(registry: Registry, cfg: Any, *args: Any, **kwargs: Any) -> Any:
    try:
        return _BUILD(registry, cfg, *args, **kwargs)
    except Exception as error:
        kind = cfg.get("type") if isinstance(cfg, Mapping) else None
        kind = registry.get(kind) if isinstance(kind, str) else kind
        _note(error, registry, kind)
        raise


def _note(error: Any, registry: Registry | None, kind: Any) -> None:
    if registry or kind:
        error.built = [*getattr(error, "built", ()), (registry, kind)]
