"""The simulator's kernels compiled by many processes at once, from a list of their signatures.

One process takes two minutes for all of them at its first place, the slowest kernel alone a sixth of that. A list that
is out of date costs nothing but time: what it lacks is compiled at its first use.
Usage: python -m benchmarks.accuracy.kernels_ahead   (writes the list anew; two minutes)
"""

from __future__ import annotations

import importlib
import json
import os
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

LIST = Path(__file__).with_suffix(".json")
#: Kernels that take less are left to their first use.
LEAST_S = 0.5

#: Module, name and signatures of a kernel.
Kernel = tuple[str, str, list[str]]


def compile_ahead(workers: int) -> int:
    """Compile the listed kernels, the slowest first; returns how many there still are."""
    kernels: list[Kernel] = json.loads(LIST.read_bytes())
    with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
        return sum(pool.map(_compile, kernels))


def _compile(kernel: Kernel) -> bool:
    from numba.core import types

    module, name, signatures = kernel
    try:
        dispatcher = getattr(importlib.import_module(module), name)
        for signature in signatures:
            # numba's own words for its types
            dispatcher.compile(eval(signature, {"__builtins__": {}}, dict(vars(types))))
    except Exception:  # noqa: BLE001
        # another version's kernel, or another numba's words
        return False
    return True


def record() -> list[Kernel]:
    """Return what the first places of both recipes compile, each kernel with what it calls, the slowest first."""
    from numba.core.dispatcher import Dispatcher

    from sim_player.dataset.shards import Recipe
    from sim_player.dataset.writer import write_dataset

    compiled, depth = Dispatcher.compile, 0
    spent_s: dict[tuple[str, str], float] = {}
    signatures: dict[tuple[str, str], list[str]] = {}

    def timed(self: Any, signature: Any) -> Any:
        nonlocal depth
        start_s, depth = time.process_time(), depth + 1
        try:
            return compiled(self, signature)
        finally:
            depth -= 1
            took_s, key = time.process_time() - start_s, (self.py_func.__module__, self.py_func.__qualname__)
            if depth == 0 and took_s >= LEAST_S:
                spent_s[key] = spent_s.get(key, 0.0) + took_s
                signatures.setdefault(key, []).append(repr(signature))

    Dispatcher.compile = timed
    with tempfile.TemporaryDirectory() as folder:
        write_dataset(Path(folder) / "all", 1, 6100, Recipe(effects="all", truth=True))
        write_dataset(Path(folder) / "auto", 2, 7)
    return [(*key, signatures[key]) for key in sorted(spent_s, key=lambda key: -spent_s[key])]


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as cache:
        # before numba is imported: nothing may be found compiled
        os.environ["NUMBA_CACHE_DIR"] = cache
        LIST.write_text(json.dumps(record(), indent=1) + "\n")
