"""Compiled functions: kernels, which Python calls, and the parts that kernels call.

numba compiles a kernel at its first call and keeps the machine code on disk, in the folder of
``NUMBA_CACHE_DIR`` or else in the user's cache. It is found by the fingerprint of the code,
wherever the code lies and however old its files are: another environment or checkout loads what the
first one has compiled. What was not used for `KEPT_FOR` is removed when something is compiled.
Parts are compiled into the kernels that call them; called from Python they run as Python.

Processes take turns: one compiles a function, and the others load what it has kept.
"""

from __future__ import annotations

import contextlib
import gc
import hashlib
import inspect
import logging
import math
import os
import pickle
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import cache, cached_property
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any, TypeVar, cast, overload

import numba
import numpy as np
import platformdirs
from numba import config, njit, types
from numba.core import serialize
from numba.core.caching import NullCache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, CompileResult
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import CPUDispatcher

from dptse_env.utils.arrays import AnyArray, BoolArray, FloatArray

logger = logging.getLogger(__name__)

_PACKAGE = __name__.partition(".")[0]

_OPTIONS: dict[str, Any] = {"error_model": "numpy", "nogil": True, "no_cfunc_wrapper": True}
_WITHOUT_PYTHON = {"nopython": True, "no_cpython_wrapper": True}
_ENDING = "machine-code"

COLLECTED_EVERY = 100_000
"""Objects after which Python looks for garbage while a kernel is compiled."""

KEPT_FOR = 30 * 24 * 3600.0
"""Seconds for which machine code that no process loads is kept on disk."""

LONGEST_WAIT = 180.0
"""Seconds to wait for a function that another process compiles; none takes more than 25 s."""

SILENT_WAIT = 1.0
"""Seconds to wait before saying so."""

Function = TypeVar("Function", bound=Callable[..., Any])


def kernel(function: Function) -> Function:
    """Compile a function that Python calls, which then runs without the interpreter's lock.

    Its machine code is kept under a fingerprint of the function and of all parts and constants
    that it reaches: a change of any of them compiles it anew.
    """
    if config.DISABLE_JIT:
        return function
    return cast("Function", _Kernel(function, {**_OPTIONS, "nopython": True}))


@overload
def kernel_part(function: Function, /) -> Function: ...
@overload
def kernel_part(**options: Any) -> Callable[[Function], Function]: ...
def kernel_part(function: Any = None, /, **options: Any) -> Any:
    """Let kernels call a function.

    A part is optimised in the kernels that call it, and has no machine code of its own: that would
    take a fifth of the time of compiling.

    Args:
        function: The function.
        options: Options of numba, such as `fastmath`.
    """

    def decorate(function: Any) -> Any:
        return _Part(function, {**_OPTIONS, **_WITHOUT_PYTHON, **options})

    return decorate if function is None else decorate(function)


def inline_part(function: Function) -> Function:
    """Let kernels call a function whose body takes the place of each call."""
    return cast("Function", njit(error_model="numpy", inline="always")(function))


@contextlib.contextmanager
def _collecting_seldom() -> Iterator[None]:
    """Let Python collect garbage seldom, since numba's compiler makes objects by the million.

    The default takes a tenth of the time of compiling.
    """
    thresholds = gc.get_threshold()
    if thresholds[0] > 0:  # with 0 the caller has none collected
        gc.set_threshold(max(thresholds[0], COLLECTED_EVERY), *thresholds[1:])
    try:
        yield
    finally:
        gc.set_threshold(*thresholds)


class _Kernel(CPUDispatcher):
    """numba's dispatcher of a kernel, which one process at a time compiles."""

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        super().__init__(function, targetoptions=options)
        self._cache = _Kept(self)

    def compile(self, sig: Any) -> Any:
        """Compile or load the version for a signature."""
        try:
            with global_compiler_lock, _collecting_seldom():
                return super().compile(sig)
        finally:
            self._cache.end_turn()


class _PartLibrary(JITCodeLibrary):
    """numba's code of a part, which is optimised and becomes machine code in kernels alone."""

    def _optimize_final_module(self) -> None: ...

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True


class _PartCompiler(Compiler):
    """numba's compiler of a part."""

    def __init__(self, typing: Any, target: Any, library: Any, *others: Any) -> None:
        super().__init__(typing, target, _PartLibrary(target.codegen(), "part"), *others)
        self.state.flags.no_compile = True


class _Part(CPUDispatcher):
    """numba's dispatcher of a function without machine code of its own."""

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        super().__init__(function, targetoptions=options, pipeline_class=_PartCompiler)

    def add_overload(self, result: Any) -> None:
        """Keep a version for kernels, which look its code up by an entry that nothing calls."""
        result = result._replace(entry_point=object())
        self.targetctx.insert_user_function(result.entry_point, result.fndesc, [result.library])
        self.overloads[tuple(result.signature.args)] = result

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """Have one version for constants and variables of a type."""
        kws = {name: types.unliteral(value) for name, value in kws.items()}
        return super().get_call_template(tuple(types.unliteral(a) for a in args), kws)

    def _compile_for_args(self, *args: Any, **keywords: Any) -> Any:
        """Return the function itself where numba asks what a call from Python is to run."""
        return self.py_func


def default_folder() -> Path:
    """Return the folder of machine code: ``NUMBA_CACHE_DIR``, or one in the user's cache."""
    if config.CACHE_DIR:
        return Path(config.CACHE_DIR)
    return platformdirs.user_cache_path("dptse-env") / "kernels"


class _Kept(NullCache):
    """The machine code of a function on disk, a file for each signature."""

    _turn: Any = None

    def __init__(self, dispatcher: CPUDispatcher) -> None:
        self._function: Any = dispatcher.py_func
        self._options, self._folder = dispatcher.targetoptions, default_folder()

    # At the first use: before that, functions that are defined further down are missing.
    @cached_property
    def _digest(self) -> str:
        return fingerprint(self._function)

    def _path(self, signature: tuple[Any, ...], codegen: Any) -> Path:
        about = (
            self._digest, _written(self._options), [_spelled(kind) for kind in signature],
            codegen.magic_tuple(), sys.implementation.cache_tag, numba.__version__,
        )  # fmt: skip
        digest = hashlib.sha256(repr(about).encode()).hexdigest()
        return self._folder / f"{_name(self._function)}-{digest[:32]}.{_ENDING}"

    def load_overload(self, signature: tuple[Any, ...], context: Any) -> Any:
        """Return kept machine code; where there is none, say that compiling begins.

        Another process may be compiling the function: then wait, and return what it has kept.
        """
        context.refresh()
        path = self._path(signature, context.codegen())
        loaded = _loaded(path, context)
        if loaded is None and _is_writable(self._folder):
            self._turn = _turn(self._function, self._folder)
            loaded = _loaded(path, context)
        if loaded is None:
            _remove_unused(self._folder)
            _announce(self._function, self._folder)
        return loaded

    def save_overload(self, signature: tuple[Any, ...], compiled: Any) -> None:
        """Keep machine code.

        Raises:
            TypeError: It holds addresses of this process.
        """
        if compiled.library.has_dynamic_globals:
            raise TypeError(f"the machine code of {_name(self._function)} holds addresses")
        if not _is_writable(self._folder):
            return
        path = self._path(signature, compiled.codegen)
        unfinished = path.with_name(f"{path.name}-{os.urandom(8).hex()}")
        try:
            unfinished.write_bytes(serialize.dumps(compiled._reduce()))
            unfinished.replace(path)
        except OSError as error:
            logger.warning("Could not keep %s: %s", path, error)

    def end_turn(self) -> None:
        """Let other processes load the function, or compile it where this one has failed."""
        if self._turn is not None:
            self._turn.release()
            self._turn = None


def _loaded(path: Path, context: Any) -> Any:
    """Return the machine code of a file, None where there is none that can be read."""
    try:
        kept = path.read_bytes()
    except OSError:
        return None
    with contextlib.suppress(OSError):  # another user's, or removed meanwhile
        os.utime(path)  # in use
    try:
        return CompileResult._rebuild(context, *pickle.loads(kept))
    except (ImportError, AttributeError):  # kept for a type that has moved or is no more
        return None
    except (pickle.UnpicklingError, EOFError):
        logger.warning("%s is damaged and made again", path)
        return None


def _turn(function: FunctionType, folder: Path) -> Any:
    """Return the lock of a function once no other process has it.

    After `LONGEST_WAIT` it is returned all the same, not taken, since compiling a function twice
    loses time only; so it is where the file system has no locks.
    """
    from filelock import FileLock, Timeout  # noqa: PLC0415  (slow to import)

    lock = FileLock(folder / f"{_name(function)}.lock", thread_local=False)
    for wait, news in (
        (SILENT_WAIT, "Waiting for another process, which compiles %s"),
        (LONGEST_WAIT, "It has not ended; compiling %s here too"),
    ):
        try:
            lock.acquire(timeout=wait)
            break
        except Timeout:
            logger.warning(news, _name(function))
        except (OSError, NotImplementedError) as error:
            _say_unlocked(folder, str(error))
            break
    return lock


@cache
def _say_unlocked(folder: Path, problem: str) -> None:
    """Say once that a folder takes no locks."""
    message = "%s takes no locks (%s); processes may compile the same function there"
    logger.warning(message, folder, problem)


@cache
def _is_writable(folder: Path) -> bool:
    """Try once in a process whether files can be kept in a folder; make it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True


def _remove_unused(folder: Path) -> None:
    """Remove machine code that was not loaded for a long time."""
    for path in folder.glob(f"*.{_ENDING}*"):
        with contextlib.suppress(OSError):  # another user's, or removed meanwhile
            if time.time() - path.stat().st_mtime > KEPT_FOR:
                path.unlink()


@cache
def _announce(function: FunctionType, folder: Path) -> None:
    """Say once in a process that a kernel is being compiled, since that takes seconds."""
    fate = f"kept in {folder}"
    if not _is_writable(folder):
        fate = "for this process only: set NUMBA_CACHE_DIR to keep it"
    logger.warning("Compiling %s (%s)", _name(function).removeprefix(f"{_PACKAGE}."), fate)


def _name(function: FunctionType) -> str:
    return f"{function.__module__}.{function.__qualname__}".replace("<locals>.", "")


def _spelled(kind: Any) -> str:
    """Write a type of numba; the name of a named tuple's leaves out its module and fields."""
    if isinstance(kind, types.StructRef):
        return f"{type(kind).__qualname__}{[_spelled(field) for _, field in kind._fields]}"
    if not isinstance(kind, types.BaseTuple):
        return str(kind)
    cls, names = getattr(kind, "instance_class", tuple), getattr(kind, "fields", ())
    elements = [_spelled(element) for element in cast("Any", kind)]
    return f"{cls.__module__}.{cls.__qualname__}{names}({', '.join(elements)})"


@cache
def fingerprint(function: FunctionType) -> str:
    """Digest of a function's code, and of the functions and constants that it uses."""
    digest, seen, waiting = hashlib.sha256(), set(), [function]
    while waiting:
        following = waiting.pop()
        if following in seen:
            continue
        seen.add(following)
        digest.update(following.__module__.encode())  # which machine code imports
        for code in _codes(following.__code__):
            constants = [c for c in code.co_consts if not isinstance(c, CodeType)]
            digest.update(repr((code.co_code, code.co_names, code.co_varnames, constants)).encode())
            for value in _used(following, code):
                if isinstance(value, FunctionType):
                    waiting.append(value)
                else:
                    digest.update(repr(value).encode())
        digest.update(repr(following.__defaults__).encode())
    return digest.hexdigest()


def _codes(code: CodeType) -> Iterator[CodeType]:
    """Yield a function's code and that of the functions inside it."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _codes(constant)


def _used(function: FunctionType, code: CodeType) -> Iterator[Any]:
    """Yield the functions that a code refers to, how they are compiled, fields, and constants."""
    values = [function.__globals__[name] for name in code.co_names if name in function.__globals__]
    modules = [m for m in values if isinstance(m, ModuleType) and m.__name__.startswith(_PACKAGE)]
    values += [vars(m)[name] for m in modules for name in code.co_names if name in vars(m)]
    for value in values:
        if callable(value):
            inside = inspect.unwrap(value)
            fields = getattr(inside, "_fields", None), inside.__module__
            yield inside if isinstance(inside, FunctionType) else fields
            yield _written(getattr(value, "targetoptions", {}))
        elif isinstance(value, np.ndarray):
            yield value.dtype, value.tolist()  # its `repr` leaves digits and elements out
        elif not isinstance(value, ModuleType):
            yield value


def _written(options: dict[str, Any]) -> str:
    """Write options of numba in the same way in each process; some are sets."""
    values = [(k, sorted(v) if isinstance(v, set) else v) for k, v in sorted(options.items())]
    return repr(values)


@kernel_part
def copy_vector(source: AnyArray, target: AnyArray) -> None:
    """Write a vector into another of its length."""
    for i in range(source.size):
        target[i] = source[i]


@kernel_part
def fill_vector(target: AnyArray, value: float) -> None:
    """Write a number into all of a vector."""
    for i in range(target.size):
        target[i] = value


@kernel_part
def copy_matrix(source: AnyArray, target: AnyArray) -> None:
    """Write a matrix into another of its shape."""
    for i in range(source.shape[0]):
        for j in range(source.shape[1]):
            target[i, j] = source[i, j]


@kernel_part
def any_of(flags: BoolArray) -> bool:
    """Return whether any flag of a vector is set."""
    for i in range(flags.size):  # noqa: SIM110, a generator takes longer to compile
        if flags[i]:
            return True
    return False


@kernel_part
def all_finite(vector: FloatArray) -> bool:
    """Return whether all numbers of a vector are finite."""
    for i in range(vector.size):  # noqa: SIM110
        if not math.isfinite(vector[i]):
            return False
    return True
