"""Compiled functions: kernels, which Python calls, and the parts that kernels call.

numba compiles a kernel at its first call and keeps the machine code on disk, in the folder of
``NUMBA_CACHE_DIR`` or else in the user's cache. It is found by the fingerprint of the code,
wherever the code lies and however old its files are: another environment or checkout loads what the
first one has compiled. What was not used for `KEPT_FOR` is removed when something is compiled.
Parts are compiled into the kernels that call them; called from Python they run as Python.

Processes take turns: one compiles a function, and the others load what it has kept. At the first
function that is not on disk a process starts others, which compile those that will be needed next;
see `dptse_env.utils.compile_ahead`.
"""

from __future__ import annotations

import contextlib
import gc
import hashlib
import inspect
import logging
import os
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
from numba.core.caching import (
    CompileResultCacheImpl,
    FunctionCache,
    IndexDataCacheFile,
    NullCache,
    _CacheLocator,
)
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import CPUDispatcher

from dptse_env.utils import compile_ahead

logger = logging.getLogger(__name__)

_PACKAGE = __name__.partition(".")[0]

_OPTIONS: dict[str, Any] = {"error_model": "numpy", "nogil": True, "no_cfunc_wrapper": True}
_WITHOUT_PYTHON = {"nopython": True, "no_cpython_wrapper": True}

COLLECTED_EVERY = 100_000
"""Objects after which Python looks for garbage while a kernel is compiled."""

KEPT_FOR = 30 * 24 * 3600.0
"""Seconds for which machine code that no process loads is kept on disk."""

TOUCHED_EVERY = 24 * 3600.0
"""Seconds after which loading machine code is noted, by the time of its files."""

Function = TypeVar("Function", bound=Callable[..., Any])


def kernel(function: Function) -> Function:
    """Compile a function that Python calls, which then runs without the interpreter's lock.

    Its machine code is kept under a fingerprint of the function and of all parts and constants
    that it reaches: a change of any of them compiles it anew.
    """
    if config.DISABLE_JIT:
        return function
    compiled: Any = _Dispatcher(function, targetoptions={**_OPTIONS, "nopython": True})
    writable = _is_writable(default_folder())
    compiled._cache = _KernelCache(compiled) if writable else _NoCache(function)
    return cast("Function", compiled)


@overload
def kernel_part(function: Function, /) -> Function: ...
@overload
def kernel_part(**options: Any) -> Callable[[Function], Function]: ...
def kernel_part(function: Any = None, /, *, kept: bool = False, **options: Any) -> Any:
    """Let kernels call a function.

    A part has no entry for Python, which saves time when it is compiled.

    Args:
        function: The function.
        kept: Keep its machine code on disk as that of a kernel. Another process can then compile
            it, and each kernel that calls it does not have to. It pays where compiling takes some
            half a second or more.
        options: Options of numba, such as `fastmath`.
    """

    def decorate(function: Any) -> Any:
        part: Any = _Part(function, targetoptions={**_OPTIONS, **_WITHOUT_PYTHON, **options})
        if kept and _is_writable(default_folder()):
            part._cache = _KernelCache(part)
        return part

    return decorate if function is None else decorate(function)


def inline_part(function: Function) -> Function:
    """Let kernels call a function whose body takes the place of each call."""
    return cast("Function", njit(error_model="numpy", inline="always")(function))


def compile_unless_busy(function: Any, signature: tuple[Any, ...]) -> None:
    """Compile a kernel or a kept part, or load it; do nothing while another process compiles it."""
    if not function._cache.is_busy():
        function.compile(signature)


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


class _Dispatcher(CPUDispatcher):
    """numba's dispatcher of a function that one process at a time compiles."""

    _cache: Any

    def compile(self, sig: Any) -> Any:
        """Compile or load the version for a signature."""
        try:
            with global_compiler_lock, _collecting_seldom():
                return super().compile(sig)
        finally:
            if isinstance(self._cache, _KernelCache):
                self._cache.end_turn()


class _Part(_Dispatcher):
    """numba's dispatcher of a function whose machine code has no entry for Python."""

    def add_overload(self, result: Any) -> None:
        """Keep a compiled version for kernels, away from the table that Python calls by."""
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


@cache
def _is_writable(folder: Path) -> bool:
    """Try once in a process whether files can be kept in a folder; make it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True


class _Locator(_CacheLocator):
    """Leads numba to one folder for all functions."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def get_cache_path(self) -> str:
        """Return the folder."""
        return str(self._folder)

    def get_source_stamp(self) -> str:
        """Return nothing: the fingerprint says what has changed."""
        return ""

    def get_disambiguator(self) -> str:
        """Return nothing: the fingerprint tells functions of one name apart."""
        return ""


class _Files(CompileResultCacheImpl):
    """numba's conversion of machine code to files and back, for one folder."""

    def __init__(self, function: FunctionType, folder: Path) -> None:
        self._locator: Any = _Locator(folder)
        self._locator._py_file = inspect.getfile(function)  # for numba's warnings
        self._lineno = function.__code__.co_firstlineno


class _KernelCache(FunctionCache):
    """numba's cache of a function, whose files are named by the fingerprint."""

    _cache_file: Any = None
    _turn: Any = None

    def __init__(self, compiled: CPUDispatcher) -> None:
        self._py_func, self._name = compiled.py_func, repr(compiled.py_func)
        self._options = compiled.targetoptions
        folder = default_folder()
        self._impl: Any = _Files(self._py_func, folder)
        self._cache_path = str(folder)
        self.enable()

    # At the first use: before that, functions that are defined further down are missing.
    @cached_property
    def _digest(self) -> str:
        text = f"{fingerprint(self._py_func)} {_written(self._options)}"
        return hashlib.sha256(text.encode()).hexdigest()

    @cached_property
    def _file_name(self) -> str:
        path = f"{self._py_func.__module__}.{self._py_func.__qualname__}".replace("<locals>.", "")
        versions = f"{sys.implementation.cache_tag}-{numba.__version__}"
        return f"{path}-{self._digest[:16]}-{versions}"

    def load_overload(self, signature: Any, context: Any) -> Any:
        """Return kept machine code; where there is none, say that compiling begins.

        Another process may be compiling the function: then wait, and return what it has kept.
        """
        kept = self._loaded(signature, context)
        if kept is None:
            folder = Path(self.cache_path)
            self._turn = compile_ahead.take_turn(self._py_func, folder)
            kept = self._loaded(signature, context)
            if kept is None:
                _remove_unused(folder)
                _announce(self._py_func, f"kept in {folder}")
                compile_ahead.start(self._py_func, signature, folder)
        return kept

    def _loaded(self, signature: Any, context: Any) -> Any:
        if self._cache_file is None:
            self._cache_file = IndexDataCacheFile(self._cache_path, self._file_name, self._digest)
        try:
            kept = super().load_overload(signature, context)
        except (ImportError, AttributeError):  # kept for a type that has moved or is no more
            self._cache_file.flush()
            return None
        if kept is not None:
            _touch(Path(self.cache_path), self._file_name)
        return kept

    def is_busy(self) -> bool:
        """Return whether another process is compiling the function."""
        return compile_ahead.is_taken(self._py_func, Path(self.cache_path))

    def end_turn(self) -> None:
        """Let other processes load the function, or compile it where this one has failed."""
        if self._turn is not None:
            self._turn.release()
            self._turn = None


class _NoCache(NullCache):
    """The cache of a kernel where no folder can keep it."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    def load_overload(self, signature: Any, context: Any) -> None:
        """Say that compiling begins, and how to have it once only."""
        _announce(self._function, "for this process only: set NUMBA_CACHE_DIR to keep it")


def _touch(folder: Path, name: str) -> None:
    """Note that machine code is in use, by the time of its files."""
    index, now = folder / f"{name}.nbi", time.time()
    with contextlib.suppress(OSError):  # another user's, or removed meanwhile
        if now - index.stat().st_mtime > TOUCHED_EVERY:
            for path in folder.glob(f"{name}.*"):
                os.utime(path)


def _remove_unused(folder: Path) -> None:
    """Remove machine code that was not loaded for a long time."""
    for path in folder.glob("*.nb[ci]*"):
        with contextlib.suppress(OSError):  # another user's, or removed meanwhile
            if time.time() - path.stat().st_mtime > KEPT_FOR:
                path.unlink()


@cache
def _announce(function: Callable[..., Any], fate: str) -> None:
    """Say once in a process that a kernel is being compiled, since that takes seconds."""
    module = function.__module__.removeprefix(f"{_PACKAGE}.")
    logger.warning("Compiling %s.%s (%s)", module, function.__name__, fate)


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
