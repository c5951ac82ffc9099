"""Readers of data sets and recordings, which create annotation files or samples."""

from gsmap.utils.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__, {"from_records": "custom", "open_input": "inputs"}
)
