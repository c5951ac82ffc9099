"""From raw recordings to annotation files or samples: a reader for each data set and format."""

from gsmap.utils.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__, {"from_records": "custom", "open_input": "inputs"}
)
