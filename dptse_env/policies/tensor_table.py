"""Tables of tensors, read from the pickle of ``torch.save`` without unpickling it.

A pickle is a program for a stack machine. The few instructions that tensors need are interpreted
here and any other is refused, so nothing that a file names is imported or called.
"""

from __future__ import annotations

import math
import pickletools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any


class _Global(Enum):
    """Functions and classes that a table of float32 tensors refers to, by module and name."""

    TENSOR = "torch._utils _rebuild_tensor_v2"
    STORAGE = "torch FloatStorage"
    HOOKS = "collections OrderedDict"


@dataclass(frozen=True)
class Storage:
    """Values of one or several tensors.

    Attributes:
        key: Name of the values in the archive.
        n_values: Number of the values.
    """

    key: str
    n_values: int


@dataclass(frozen=True)
class TensorEntry:
    """A contiguous part of a storage.

    Attributes:
        storage: The storage.
        offset: Index of the first value.
        shape: Shape of the tensor.
    """

    storage: Storage
    offset: int
    shape: tuple[int, ...]


def read_table(pickled: bytes) -> dict[str, TensorEntry]:
    """Return the tensors of a pickled mapping by name.

    Raises:
        ValueError: The pickle is damaged, or holds anything but float32 tensors by name.
    """
    machine = _Machine()
    try:
        for opcode, argument, _ in pickletools.genops(pickled):
            machine.execute(opcode.name, argument)
    except (IndexError, KeyError) as problem:
        raise ValueError("its table of weights is damaged") from problem
    if len(machine.stack) != 1 or not isinstance(machine.stack[0], dict):
        raise ValueError("its weights must be a mapping of names to tensors")
    return machine.stack[0]


_LITERALS = ("BINUNICODE", "BININT", "BININT1", "BININT2")
_EMPTY: Mapping[str, type] = {"NEWFALSE": bool, "EMPTY_TUPLE": tuple, "EMPTY_DICT": dict}
_TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
_IGNORED = ("PROTO", "STOP")


class _Machine:
    """The stack machine."""

    def __init__(self) -> None:
        self.stack: list[Any] = []
        self._marks: list[int] = []
        self._memo: dict[Any, Any] = {}

    def execute(self, name: str, argument: Any) -> None:
        """Execute an instruction, by its name in `pickletools`."""
        if name in _LITERALS:
            self.stack.append(argument)
        elif name in _EMPTY:
            self.stack.append(_EMPTY[name]())
        elif name in _TUPLES:
            self.stack.append(tuple(self._pop(len(self.stack) - _TUPLES[name])))
        elif name in _METHODS:
            _METHODS[name](self, argument)
        elif name not in _IGNORED:
            raise ValueError(
                f"its weights hold more than tensors (pickle instruction {name}), and nothing "
                "else is loaded"
            )

    def mark(self, _: Any) -> None:
        self._marks.append(len(self.stack))

    def put(self, index: Any) -> None:
        self._memo[index] = self.stack[-1]

    def get(self, index: Any) -> None:
        self.stack.append(self._memo[index])

    def join(self, _: Any) -> None:
        self.stack.append(tuple(self._pop(self._marks.pop())))

    def store_one(self, _: Any) -> None:
        _store(self._pop(len(self.stack) - 2), self.stack[-1])

    def store(self, _: Any) -> None:
        _store(self._pop(self._marks.pop()), self.stack[-1])

    def refer(self, name: Any) -> None:
        known = {item.value: item for item in _Global}
        if name not in known:
            raise ValueError(
                f"its weights hold more than float32 tensors ({name!r}), and nothing else is loaded"
            )
        self.stack.append(known[name])

    def find_storage(self, _: Any) -> None:
        self.stack.append(_storage(self.stack.pop()))

    def call(self, _: Any) -> None:
        arguments = self.stack.pop()
        self.stack.append(_result(self.stack.pop(), arguments))

    def _pop(self, start: int) -> list[Any]:
        """Remove and return the items of the stack from a position on."""
        if not 0 <= start <= len(self.stack):
            raise IndexError
        items = self.stack[start:]
        del self.stack[start:]
        return items


_METHODS: Mapping[str, Callable[[_Machine, Any], None]] = {
    "MARK": _Machine.mark,
    "BINPUT": _Machine.put,
    "LONG_BINPUT": _Machine.put,
    "BINGET": _Machine.get,
    "LONG_BINGET": _Machine.get,
    "TUPLE": _Machine.join,
    "SETITEM": _Machine.store_one,
    "SETITEMS": _Machine.store,
    "GLOBAL": _Machine.refer,
    "BINPERSID": _Machine.find_storage,
    "REDUCE": _Machine.call,
}


def _storage(identifier: object) -> Storage:
    """Return the storage of a persistent identifier; the device that it was on does not matter."""
    match identifier:
        case ("storage", _Global.STORAGE, str(key), str(_), int(n_values)) if n_values >= 0:
            return Storage(key, n_values)
    raise ValueError("its table of weights has an unknown kind of storage")


def _result(function: object, arguments: object) -> TensorEntry | dict[str, Any]:
    """Return the result of a call that describes a tensor."""
    match function, arguments:
        case _Global.HOOKS, ():
            return {}
        case (
            _Global.TENSOR,
            (Storage() as storage, int(offset), tuple(shape), tuple(stride), False, dict()),
        ):
            _check_layout(offset, shape, stride)
            return TensorEntry(storage, offset, shape)
    raise ValueError("its table of weights has an unknown kind of tensor")


def _check_layout(offset: int, shape: tuple[Any, ...], stride: tuple[Any, ...]) -> None:
    """Refuse tensors whose values do not lie one after the other."""
    if len(shape) > 4 or not all(isinstance(n, int) and n >= 0 for n in (offset, *shape, *stride)):
        raise ValueError("its table of weights has an impossible shape")
    contiguous = [math.prod(shape[k + 1 :]) for k in range(len(shape))]
    # The stride of a dimension of size 1 is never used.
    if len(stride) != len(shape) or any(
        n > 1 and step != wanted for n, step, wanted in zip(shape, stride, contiguous, strict=True)
    ):
        raise ValueError("its weights must be contiguous")


def _store(items: list[Any], mapping: object) -> None:
    """Put alternating names and tensors into a mapping."""
    if not isinstance(mapping, dict) or len(items) % 2:
        raise ValueError("its table of weights is damaged")
    for name, value in zip(items[::2], items[1::2], strict=True):
        if not isinstance(name, str) or not isinstance(value, TensorEntry):
            raise ValueError("its weights must be a mapping of names to tensors")
        mapping[name] = value
