"""Compiled kernels: numba's, kept in its cache, and loaded from there without its compiler.

Numba imports all that it could compile, a third of a second and 25 MiB a process, and reads the form that others are
compiled from, two thirds of a load; here only who compiles does. Kernels and numbers of other files count as a kernel's
source.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable, Iterator
from types import ModuleType
from typing import Any, ClassVar

import llvmlite.binding as llvm
import numpy as np
from numba import njit
from numba.core.caching import CompileResultCacheImpl, FunctionCache
from numba.core.registry import cpu_target
from numba.core.runtime import rtsys

#: Changes with what is kept of a kernel.
FORMAT = 3


def compiled(
    function: Callable[..., Any] | None = None, /, *, error_model: str = "python", fastmath: bool = False
) -> Any:
    """Compile a function of numbers and arrays at its first call, and keep it for later processes; it holds no lock.

    `error_model` "python" raises on division by zero, "numpy" does not; `fastmath`: sums may be ordered anew.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        # copies of a fast callee may sum in different orders, and the one loaded first runs: inlined, none is left
        kernel = njit(nogil=True, error_model=error_model, fastmath=fastmath, forceinline=fastmath)(function)
        kernel._cache = KernelCache(function)
        return kernel

    return decorate if function is None else decorate(function)


def prepare() -> None:
    """Set up what the first kernel of a process would."""
    rtsys.initialize(cpu_target.target_context)


class KernelFile(CompileResultCacheImpl):
    """What is kept of a compiled function: machine code, the form that others are compiled from, and names in it."""

    def reduce(self, result: Any) -> tuple[list[str], bytes, tuple[Any, ...]]:
        """Return what is kept."""
        (name, kind, (code, linkable)), *rest = super().reduce(result)
        module = result.library._get_module_for_linking()
        names = [
            item.name
            for items in (module.functions, module.global_variables)
            for item in items
            if not item.is_declaration
        ]
        return names, linkable, ((name, kind, (code, _nothing())), *rest)

    def rebuild(self, target_context: Any, kept: tuple[list[str], bytes, tuple[Any, ...]]) -> Any:
        """Return the compiled function."""
        names, linkable, payload = kept
        # the engine cannot tell which names are in machine code: numba takes them from the form that is not read here
        target_context.codegen()._engine._defined_symbols.update(names)
        result = super().rebuild(target_context, payload)
        result.library._get_module_for_linking = functools.cache(lambda: llvm.parse_bitcode(linkable))
        return result


@functools.cache
def _nothing() -> bytes:
    """Return an empty module in the form that kernels are compiled from."""
    return bytes(llvm.parse_assembly("").as_bitcode())


class KernelCache(FunctionCache):
    """The compiled forms of one function on disk."""

    _impl_class = KernelFile
    #: Kernels that this process has compiled: with one it holds the compiler.
    compiled: ClassVar[int] = 0

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the function as it was compiled for a signature, or None."""
        rtsys.initialize(target_context)
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep what has been compiled."""
        KernelCache.compiled += 1
        super().save_overload(sig, data)

    @functools.cached_property
    def stamp(self) -> str:
        """What changes whenever this function's file, or a kernel or number that it uses, does."""
        parts = [FORMAT, self._cache_file._source_stamp, *sorted(set(self._used()))]
        return hashlib.sha256(repr(parts).encode()).hexdigest()

    def _index_key(self, sig: Any, codegen: Any) -> tuple[Any, ...]:
        return (*super()._index_key(sig, codegen), self.stamp)

    def _used(self) -> Iterator[tuple[str, str]]:
        """Yield names and stamps of what the names in the function's code may mean."""
        names, known = self._py_func.__code__.co_names, self._py_func.__globals__
        for name in names:
            value = known.get(name)
            # `mirror.crosses(...)`: one of the code's other names, in that module
            meant = [getattr(value, other, None) for other in names] if isinstance(value, ModuleType) else [value]
            for item in meant:
                if stamp := self._stamp_of(item):
                    yield name, stamp

    def _stamp_of(self, item: object) -> str:
        cache = getattr(item, "_cache", None)
        if isinstance(cache, KernelCache):
            # a function that calls itself is in its own file
            return "" if cache is self else cache.stamp
        if isinstance(item, np.ndarray):
            return hashlib.sha256(item.tobytes()).hexdigest()
        return repr(item) if isinstance(item, (bool, int, float, complex, str, tuple, np.generic)) else ""
