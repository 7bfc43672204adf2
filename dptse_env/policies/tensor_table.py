"""Tables of tensors, read from the pickle of ``torch.save`` without unpickling it.

A pickle is a program for a stack machine. The few instructions that tensors need are interpreted
here and any other is refused, so nothing that is named in a file is imported or called.
"""

import math
import pickletools
import warnings
from dataclasses import dataclass
from enum import Enum
from typing import Any


class _Global(Enum):
    """Functions and classes in a table of float32 tensors, by module and name."""

    TENSOR = "torch._utils _rebuild_tensor_v2"
    STORAGE = "torch FloatStorage"
    HOOKS = "collections OrderedDict"


@dataclass(frozen=True)
class Storage:
    """Values of one or several tensors."""

    key: str  # name of the entry in the archive
    n_values: int


@dataclass(frozen=True)
class TensorEntry:
    """A contiguous part of a storage."""

    storage: Storage
    offset: int  # index of the first value
    shape: tuple[int, ...]


def read_table(pickled: bytes) -> dict[str, TensorEntry]:
    """Return the tensors of a pickled mapping by name.

    Raises:
        ValueError: The pickle is damaged, or holds anything but float32 tensors by name.
    """
    machine = _Machine()
    try:
        with warnings.catch_warnings():
            # Raised for a name with an invalid escape sequence, which no saved policy holds.
            warnings.simplefilter("error", DeprecationWarning)
            for opcode, argument, _ in pickletools.genops(pickled):
                machine.execute(opcode.name, argument)
    except (IndexError, KeyError, DeprecationWarning) as problem:
        raise ValueError("its table of weights is damaged") from problem
    match machine.stack:
        case [dict() as table]:
            return table
    raise ValueError("its weights must be a mapping of names to tensors")


class _Machine:
    """The stack machine."""

    def __init__(self) -> None:
        self.stack: list[Any] = []
        self._marks: list[int] = []
        self._memo: dict[Any, Any] = {}

    def execute(self, name: str, argument: Any) -> None:  # noqa: PLR0912 (a case per instruction)
        """Execute an instruction, by its name in `pickletools`."""
        push = self.stack.append
        match name:
            case "PROTO" | "STOP":
                pass
            case "BINUNICODE" | "BININT" | "BININT1" | "BININT2":
                push(argument)
            case "NEWFALSE":
                push(False)
            case "EMPTY_DICT":
                push({})
            case "EMPTY_TUPLE":
                push(())
            case "TUPLE1" | "TUPLE2" | "TUPLE3":
                push(tuple(self._pop(int(name[-1]))))
            case "MARK":
                self._marks.append(len(self.stack))
            case "TUPLE":
                push(tuple(self._pop_marked()))
            case "BINPUT" | "LONG_BINPUT":
                self._memo[argument] = self.stack[-1]
            case "BINGET" | "LONG_BINGET":
                push(self._memo[argument])
            case "SETITEM":
                _store(self._pop(2), self.stack[-1])
            case "SETITEMS":
                _store(self._pop_marked(), self.stack[-1])
            case "GLOBAL":
                push(_global(argument))
            case "BINPERSID":
                push(_storage(self.stack.pop()))
            case "REDUCE":
                push(_result(*self._pop(2)))
            case _:
                raise ValueError(
                    f"its weights hold more than tensors (pickle instruction {name}), and nothing "
                    "else is loaded"
                )

    def _pop(self, n: int) -> list[Any]:
        """Remove and return the last n items of the stack."""
        start = len(self.stack) - n
        if not 0 <= start <= len(self.stack):
            raise IndexError
        items = self.stack[start:]
        del self.stack[start:]
        return items

    def _pop_marked(self) -> list[Any]:
        """Remove and return the items of the stack from the last mark on."""
        return self._pop(len(self.stack) - self._marks.pop())


def _global(name: str) -> _Global:
    """Return a function or class by module and name."""
    try:
        return _Global(name)
    except ValueError:
        raise ValueError(
            f"its weights hold more than float32 tensors ({name!r}), and nothing else is loaded"
        ) from None


def _storage(identifier: object) -> Storage:
    """Return the storage of a persistent identifier, on whichever device it was saved."""
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
    """Refuse tensors whose values are not contiguous."""
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
