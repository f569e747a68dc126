"""Read a pickle that was downloaded, as plain data: lists, tuples, dicts, texts, numbers, booleans and None.

Unpickling calls whatever the file names, so a pickle can run any program, and forged array bytes corrupt memory. This
reader looks at every opcode first and refuses those that name or build anything else, so nothing is called at all.
Sizes, depth and numbers are limited as well: a few bytes can describe a value that takes hours to print.
"""

from __future__ import annotations

import io
import pickle
import pickletools
from pathlib import Path
from typing import Any, cast

from a4agent.errors import DataError

MAX_BYTES = 64_000_000
MAX_VALUES = 5_000_000
MAX_DEPTH = 16
MAX_BITS = 64

PLAIN_OPCODES = frozenset(
    (
        *("PROTO", "FRAME", "STOP", "MARK", "POP", "POP_MARK"),
        *("NONE", "NEWTRUE", "NEWFALSE", "INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4"),
        *("FLOAT", "BINFLOAT", "UNICODE", "SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8"),
        *("STRING", "BINSTRING", "SHORT_BINSTRING", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8"),
        *("EMPTY_LIST", "LIST", "APPEND", "APPENDS", "EMPTY_TUPLE", "TUPLE", "TUPLE1", "TUPLE2", "TUPLE3"),
        *("EMPTY_DICT", "DICT", "SETITEM", "SETITEMS"),
        *("PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE", "GET", "BINGET", "LONG_BINGET"),
    )
)
"""What plain data needs. Everything that imports or calls (GLOBAL, REDUCE, BUILD, ...) is missing on purpose."""


def load(path: Path) -> Any:
    """The value in a pickle of plain data.

    Raises:
        DataError: missing, damaged, too large or too deep, or it names a class or function.
    """
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise DataError(f"it has {size} bytes, over the limit of {MAX_BYTES}")
        data = path.read_bytes()
        _check_opcodes(data)
        value = _PlainUnpickler(io.BytesIO(data)).load()
        _check_value(value)
    except DataError as error:
        raise DataError(f"cannot open {str(path)!r}: {error}") from None
    except FileNotFoundError as error:
        raise DataError(f"no such file: {str(path)!r}") from error
    except Exception as error:  # a damaged pickle raises almost anything, from IndexError to MemoryError
        raise DataError(f"{str(path)!r} is not a readable pickle: {error!r:.300}") from error
    return value


class _PlainUnpickler(pickle.Unpickler):
    def find_class(self, module_name: str, global_name: str) -> Any:
        raise DataError(_refusal(f"{module_name}.{global_name}"))


def _refusal(name: str) -> str:
    return f"the pickle asks for {name}; only lists, dicts, texts and numbers are read, so that no program can run"


def _check_opcodes(data: bytes) -> None:
    """Refuse opcodes that plain data does not need, and memo slots far beyond the file's own size.

    Raises:
        DataError: such an opcode; the message names what it asks for.
        ValueError: not a pickle.
    """
    texts = ("", "")
    for opcode, argument, _ in pickletools.genops(data):
        if isinstance(argument, str):
            texts = (texts[1], argument)
        if opcode.name not in PLAIN_OPCODES:
            named = {"GLOBAL": str(argument).replace(" ", "."), "STACK_GLOBAL": ".".join(texts)}
            raise DataError(_refusal(f"{named.get(opcode.name, opcode.name)!s:.200}"))
        if opcode.name.endswith(("PUT", "GET")) and not 0 <= int(cast(Any, argument)) <= len(data):
            raise DataError(f"memo slot {argument} in a file of {len(data)} bytes")


def _check_value(value: Any) -> None:
    """Walk through a value once, whatever it shares with itself.

    Raises:
        DataError: it is too large or too deep, or holds a number of more than MAX_BITS bits.
    """
    seen: set[int] = set()
    level = [value]
    for _ in range(MAX_DEPTH):
        below: list[Any] = []
        for one in level:
            if isinstance(one, int) and one.bit_length() > MAX_BITS:
                raise DataError(f"an integer of {one.bit_length()} bits; the limit is {MAX_BITS}")
            if not isinstance(one, (list, tuple, dict)) or id(cast(Any, one)) in seen:
                continue
            seen.add(id(cast(Any, one)))
            below += [*cast(Any, one), *cast(Any, one).values()] if isinstance(one, dict) else cast("list[Any]", one)
            if len(seen) + len(below) > MAX_VALUES:
                raise DataError(f"it holds more than {MAX_VALUES} values")
        if not below:
            return
        level = below
    raise DataError(f"values are nested more than {MAX_DEPTH} deep")
