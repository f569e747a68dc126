"""Read a pickle that came from a download: plain data only, anything else is refused by name.

Unpickling calls whatever the file names, so a pickle can run any program. This reader knows lists, dicts,
texts, numbers and numpy arrays, and raises before anything else is even imported.
"""

from __future__ import annotations

import importlib
import pickle
from pathlib import Path
from typing import Any

from a4agent.errors import DataError

ALLOWED = {
    ("collections", "OrderedDict"),
    ("_codecs", "encode"),  # how protocol 2 writes bytes
    ("numpy", "dtype"),
    ("numpy", "ndarray"),
    *((f"numpy.{core}.multiarray", name) for core in ("core", "_core") for name in ("_reconstruct", "scalar")),
    *((f"numpy.{core}.numeric", "_frombuffer") for core in ("core", "_core")),
}
"""The classes and functions a pickle may name, as (module, name); numpy 2 renamed `core` to `_core`."""


def load(path: Path) -> Any:
    """The value in a pickle of plain data.

    Raises:
        DataError: missing, damaged, or it names a class or function that plain data does not need.
    """
    try:
        with path.open("rb") as file:
            return _Unpickler(file).load()
    except DataError as error:
        raise DataError(f"{str(path)!r} was not opened: {error}") from None
    except FileNotFoundError as error:
        raise DataError(f"no such file: {str(path)!r}") from error
    except Exception as error:  # a damaged pickle raises almost anything, from IndexError to MemoryError
        raise DataError(f"{str(path)!r} is not a pickle that can be read: {error!r}") from error


class _Unpickler(pickle.Unpickler):
    def find_class(self, module_name: str, global_name: str) -> Any:
        if (module_name, global_name) not in ALLOWED:
            raise DataError(
                f"the pickle asks for {module_name}.{global_name}, which a dataset of lists, dicts, texts, numbers and "
                "numpy arrays does not need; it may be meant to run a program on this machine"
            )
        try:
            module = importlib.import_module(module_name.replace("numpy.core.", "numpy._core."))
        except ModuleNotFoundError:  # numpy 1 has no `_core.numeric`
            module = importlib.import_module(module_name.replace("numpy._core.", "numpy.core."))
        return getattr(module, global_name)
