"""Compiled functions: kernels, which Python calls, and the parts that kernels call.

numba compiles a kernel at its first call, and the machine code is kept on disk, in the folder of
``NUMBA_CACHE_DIR`` or else in the user's cache. numba's own cache knows a function by its file
alone: it would go on with machine code whose parts or constants, in other files, have changed. Here
it is found by the fingerprint of all the code that it reaches, wherever that lies.

Parts are compiled into the kernels that call them; called from Python they run as Python.
"""

from __future__ import annotations

import errno
import gc
import hashlib
import inspect
import logging
import math
import os
import pickle
import sys
import threading
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
from numba.experimental import structref

from dptse_env.utils.arrays import AnyArray, BoolArray, FloatArray
from dptse_env.utils.files import replacing

logger = logging.getLogger(__name__)

_PACKAGE = __name__.partition(".")[0]

_SLOW = f"{_PACKAGE}.estimators."
"""Modules of kernels that take long to compile; one of the others takes a second at most."""

compiling_is_said = threading.Event()
"""Set once this process has said that it compiles."""

_OPTIONS: dict[str, Any] = {
    "error_model": "numpy", "nogil": True, "nopython": True, "no_cfunc_wrapper": True,
}  # fmt: skip

COLLECTED_EVERY = 100_000
"""Objects after which Python looks for garbage while a kernel is compiled."""

Function = TypeVar("Function", bound=Callable[..., Any])


def kernel(function: Function) -> Function:
    """Compile a function that Python calls, which then runs without the interpreter's lock."""
    if config.DISABLE_JIT:
        return function
    return cast("Function", _Kernel(function, _OPTIONS))


@overload
def kernel_part(function: Function, /) -> Function: ...
@overload
def kernel_part(**options: Any) -> Callable[[Function], Function]: ...
def kernel_part(function: Any = None, /, **options: Any) -> Any:
    """Let kernels call a function.

    A part is optimised in the kernels that call it, and has no machine code of its own: that would
    take half as long again to compile, and for the MHE three times as long.

    Args:
        function: The function.
        options: Options of numba, such as `fastmath`.
    """

    def decorate(function: Any) -> Any:
        return _Part(function, {**_OPTIONS, "no_cpython_wrapper": True, **options})

    return decorate if function is None else decorate(function)


def inline_part(function: Function) -> Function:
    """Let kernels call a function whose body takes the place of each call.

    It saves passing named tuples of many arrays, which go one by one: 0.1 us for a road.
    """
    return cast("Function", njit(error_model="numpy", inline="always")(function))


class _PartLibrary(JITCodeLibrary):
    """Code library that is linked into its callers and never compiled on its own."""

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


class _Kernel(CPUDispatcher):
    """numba's dispatcher of a kernel, whose machine code is kept on disk."""

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        super().__init__(function, targetoptions=options)
        self._cache = _Kept(function)

    def compile(self, sig: Any) -> Any:
        """Compile or load the version for a signature.

        Python collects garbage seldom meanwhile, since the compiler makes objects by the million;
        as often as usual, that takes a tenth of the time.
        """
        with global_compiler_lock:
            usual = gc.get_threshold()
            if usual[0] > 0:  # with 0 the caller has none collected
                gc.set_threshold(max(usual[0], COLLECTED_EVERY), *usual[1:])
            try:
                return super().compile(sig)
            finally:
                gc.set_threshold(*usual)


def default_folder() -> Path:
    """Return the folder of machine code: ``NUMBA_CACHE_DIR``, or one in the user's cache."""
    if config.CACHE_DIR:
        return Path(config.CACHE_DIR)
    return platformdirs.user_cache_path("dptse-env") / "kernels"


class _Kept(NullCache):
    """The machine code of a function on disk, a file for each signature.

    numba's own cache has an index of files, which can name the code that another process wrote.
    """

    def __init__(self, function: Any) -> None:
        self._function, self._folder = function, default_folder()
        self._name = f"{function.__module__}.{function.__qualname__}".replace("<locals>.", "")

    # At the first use: before that, functions that are defined further down are missing.
    @cached_property
    def _fingerprint(self) -> str:
        return fingerprint(self._function)

    def _path(self, signature: tuple[Any, ...], codegen: Any) -> Path:
        about = (
            self._fingerprint, list(map(_spelled, signature)), codegen.magic_tuple(),
            numba.__version__, sys.implementation.cache_tag,
        )  # fmt: skip
        digest = hashlib.sha256(repr(about).encode()).hexdigest()
        return self._folder / f"{self._name}-{digest[:32]}.machine-code"

    def load_overload(self, signature: tuple[Any, ...], context: Any) -> Any:
        """Return kept machine code, or None."""
        context.refresh()
        loaded = _loaded(self._path(signature, context.codegen()), context)
        if loaded is None and self._name.startswith(_SLOW) and not compiling_is_said.is_set():
            compiling_is_said.set()
            logger.warning(
                "Compiling the estimator, once on this machine: about 10 s, the MHE 25 s"
            )
        return loaded

    def save_overload(self, signature: tuple[Any, ...], compiled: Any) -> None:
        """Keep machine code, unless it holds addresses of this process."""
        if compiled.library.has_dynamic_globals:
            raise TypeError(f"the machine code of {self._name} holds addresses")
        path = self._path(signature, compiled.codegen)
        content = serialize.dumps(compiled._reduce())
        try:
            self._folder.mkdir(0o700, parents=True, exist_ok=True)
            if not _is_private(self._folder):
                raise PermissionError(errno.EPERM, "others can write to it")
            if path.is_dir():
                path.rmdir()  # if it is empty
            with replacing(path) as temporary:
                temporary.touch(0o600)
                temporary.write_bytes(_digest(path, content) + b"\n" + content)
        except OSError as problem:
            _say_not_kept(self._folder, problem.strerror)


def _loaded(path: Path, context: Any) -> Any:
    """Return the machine code of a file, None where there is none that can be used.

    To read it is to run it, so nobody but the user may have written it. Who can write to a folder
    further up can put another one in its place, but none that belongs to the user.
    """
    try:
        if not _is_private(path.parent):
            return None
        kept = path.read_bytes() if _is_private(path) else b""
    except OSError:  # it is missing, or else `save_overload` says or mends it
        return None
    digest, _, content = kept.partition(b"\n")
    if digest != _digest(path, content):
        logger.warning("%s is damaged, or others can write to it: it is made again", path)
        return None
    return CompileResult._rebuild(context, *pickle.loads(content))


def _is_private(path: Path) -> bool:
    """Return whether a file or folder is the user's, and nobody else can write to it."""
    if os.name == "nt":  # which has other rights, and a cache of each user
        return True
    status = path.stat()
    return status.st_uid == os.getuid() and not status.st_mode & 0o022


def _digest(path: Path, content: bytes) -> bytes:
    """Return the digest of machine code in the file of a name."""
    return hashlib.sha256(path.name.encode() + content).hexdigest().encode()


@cache
def _say_not_kept(folder: Path, problem: str | None) -> None:
    """Say once that machine code cannot be kept in a folder."""
    logger.warning(
        "%s cannot keep machine code (%s): "
        "set NUMBA_CACHE_DIR to a folder that only you can write to",
        folder,
        problem,
    )


def _spelled(kind: Any) -> str:
    """Write a type of numba, whose own name leaves out modules and fields."""
    if isinstance(kind, types.StructRef):
        return f"{type(kind)}{[_spelled(field) for _, field in kind._fields]}"
    if not isinstance(kind, types.BaseTuple):
        return str(kind)
    cls, names = getattr(kind, "instance_class", tuple), getattr(kind, "fields", ())
    elements = [_spelled(element) for element in cast("Any", kind)]
    return f"{cls}{names}({', '.join(elements)})"


@cache
def fingerprint(function: FunctionType) -> str:
    """Digest of a function's code, and of the functions and constants that it uses."""
    digest, seen, waiting = hashlib.sha256(), set(), [function]
    while waiting:
        following = waiting.pop()
        if following in seen:
            continue
        seen.add(following)
        # Machine code refers to functions and types by module and name.
        digest.update(repr((following.__module__, following.__defaults__)).encode())
        for code in _codes(following.__code__):
            constants = [c for c in code.co_consts if not isinstance(c, CodeType)]
            digest.update(repr((code.co_code, code.co_names, code.co_varnames, constants)).encode())
            for value in _used(following, code):
                if isinstance(value, FunctionType):
                    waiting.append(value)
                else:
                    digest.update(repr(value).encode())
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
            yield inside if isinstance(inside, FunctionType) else inside.__module__
            yield getattr(inside, "__qualname__", None), getattr(value, "_fields", None)
            options = getattr(value, "targetoptions", {})
            # In the same order in each process; some are sets.
            yield sorted((k, sorted(v) if isinstance(v, set) else v) for k, v in options.items())
        elif isinstance(value, np.ndarray):
            yield value.dtype, value.tolist()  # its `repr` leaves digits and elements out
        elif not isinstance(value, ModuleType):
            yield value


@structref.register
class _BundleType(types.StructRef):
    """numba's type of a bundle."""

    def preprocess_fields(self, fields: Any) -> Any:
        """Keep one version for constants and variables of a type."""
        return tuple((name, types.unliteral(kind)) for name, kind in fields)


class Bundle(structref.StructRefProxy):
    """Named tuples of arrays and numbers as one argument of kernels.

    To pass a filter's forty arrays one by one takes 4 us, a third of its step at one episode, and a
    bundle of them less than one. Its arrays are those that it was made of, not copies.

    Attributes:
        parts: The named tuples.
    """

    parts: Any

    def __new__(cls, *parts: Any) -> Bundle:
        """Make a bundle of named tuples."""
        bundle: Bundle = _bundled(parts)
        bundle.parts = parts
        return bundle

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy, or pickle, the arrays."""
        return Bundle, self.parts


structref.define_proxy(Bundle, _BundleType, ["parts"])


@kernel
def _bundled(parts: Any) -> Any:
    return Bundle(parts)


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
