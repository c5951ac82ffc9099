"""Reading of pickles that hold plain data, without the power to run code."""

import pickle
from pathlib import Path
from typing import Any

# All that plain containers of Python and numpy values need; none of these can act outside itself.
_ALLOWED = frozenset(
    {
        ("collections", "OrderedDict"),
        ("_codecs", "encode"),
        ("numpy", "dtype"),
        ("numpy", "ndarray"),
        ("numpy.core.multiarray", "_reconstruct"),
        ("numpy.core.multiarray", "scalar"),
        ("numpy.core.numeric", "_frombuffer"),
        ("numpy._core.numeric", "_frombuffer"),
        ("numpy._core.multiarray", "_reconstruct"),
        ("numpy._core.multiarray", "scalar"),
    }
)


class PlainUnpickler(pickle.Unpickler):
    """An unpickler that admits containers, numbers, strings and numpy arrays, and nothing else."""

    def find_class(self, module: str, name: str) -> Any:
        """Look up a class by name, if it is on the list.

        Raises:
            pickle.UnpicklingError: If it is not.
        """
        if (module, name) not in _ALLOWED:
            raise pickle.UnpicklingError(f"it asks for {module}.{name}, which is not plain data")
        return super().find_class(module.replace("numpy._core", "numpy.core"), name)


def load_plain_pickle(path: str | Path) -> Any:
    """Read a pickle of plain containers and numpy values.

    Args:
        path: The file.

    Returns:
        Its content.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is not a whole pickle, or asks for anything but plain data.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"There is no file {path}.")
    try:
        with path.open("rb") as file:
            return PlainUnpickler(file).load()
    except (
        pickle.UnpicklingError,
        EOFError,
        AttributeError,
        IndexError,
        KeyError,
        TypeError,
    ) as error:
        raise ValueError(
            f"{path} cannot be read as a pickle of plain data: {error}. Nothing of it was run: "
            "fetch it again, or save it anew with lists, dicts and numpy arrays only."
        ) from error
