"""Reading of pickles that hold plain data; it lives with the data sets, whose converters use it."""

from gsmap.datasets.plain_pickle import PlainUnpickler, load_plain_pickle

__all__ = ["PlainUnpickler", "load_plain_pickle"]
