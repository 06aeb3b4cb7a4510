"""Memory given back: which pages may go, that code still runs afterwards, and heap that beams left behind."""

from __future__ import annotations

import subprocess
import sys

import pytest

from msgs.files.shipped import CHECKOUT
from nodes.process.fork_server import environment
from nodes.process.memory import Mapping, is_as_in_file, mappings, parse_smaps

MIB = 1 << 20
_SMAPS = """\
7f0000000000-7f0000200000 r-xp 00001000 08:01 12   /usr/lib/libone two.so
Size:               2048 kB
Rss:                1024 kB
Pss:                 512 kB
Anonymous:             0 kB
VmFlags: rd ex mr mw me
7f0000200000-7f0000300000 r--p 00200000 08:01 12   /usr/lib/libone two.so
Rss:                  64 kB
Pss:                  64 kB
Anonymous:            64 kB
7f0000300000-7f0000400000 rw-p 00000000 00:00 0
Rss:                   8 kB
Anonymous:             8 kB
"""


def test_mappings_are_read_as_the_kernel_writes_them() -> None:
    code, relocated, own = parse_smaps(_SMAPS.splitlines(keepends=True))
    assert code == Mapping(0x7F0000000000, 0x7F0000200000, "r-xp", "/usr/lib/libone two.so", MIB, MIB // 2, 0)
    assert (relocated.anonymous, own.path, own.pss) == (64 << 10, "", 0)
    # what the loader wrote into a page is in no file
    assert [is_as_in_file(item) for item in (code, relocated, own)] == [True, False, False]


def test_own_mappings_are_whole() -> None:
    found = mappings()
    assert any("libc" in item.path and is_as_in_file(item) for item in found)
    assert sum(item.rss for item in found) > 10 * MIB


_COMPILER = """
import numpy as np
from models.perception.form.slow_time_sums import fold_chirps
from nodes.process.memory import mappings, release_unused

def resident():
    return sum(item.rss for item in mappings() if "llvmlite" in item.path) >> 20

samples = np.arange(2 * 8 * 2, dtype=np.int16).reshape(2, 8, 2)
before, sums = resident(), fold_chirps(samples, 1)[0]
loaded = resident()
release_unused()
left = resident()
assert np.array_equal(fold_chirps(samples, 1)[0], sums)
# a kernel of other types: the compiler runs again
assert fold_chirps(np.zeros((5, 8, 2), np.int16), 2)[0].shape == (2, 8, 2)
print(before, loaded, left)
"""

_BEAMS = """
import numpy as np
from nodes.process.memory import LOOKS, FreeHeap
import psutil

def resident():
    return psutil.Process().memory_info().rss >> 20

heap, kept = FreeHeap(), []
before = resident()

def burst():
    waiting = [(np.ones(1 << 20, np.int32), bytes(1 << 16)) for _ in range(40)]
    # small things that live on hold the heap's end
    kept.extend(small for _, small in waiting)
    return resident()

full, freed = burst(), resident()
for _ in range(LOOKS):
    heap.give_back()
after = resident()
# as many more between two looks
for _ in range(LOOKS):
    heap.give_back()
burst()
for _ in range(LOOKS):
    heap.give_back()
again = resident()
# beams that come and go between the looks
for look in range(3 * LOOKS):
    beam = np.ones((1 << 20) * (1 + look % 2), np.int32)
    heap.give_back()
    del beam
print(before, full, freed, after, again, resident())
"""


def _said(script: str) -> list[int]:
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, cwd=CHECKOUT, env=environment({}), capture_output=True, text=True, check=True)
    return [int(word) for word in done.stdout.split()]


@pytest.mark.slow
def test_code_that_only_the_start_ran_goes_and_comes_back() -> None:
    before, loaded, left = _said(_COMPILER)
    assert loaded >= before > 0
    assert left < 0.25 * loaded


@pytest.mark.slow
def test_beams_that_waited_leave_no_memory_behind() -> None:
    """Under the allocator's settings of a node 160 MiB stayed for good, and as much again that came between two looks.

    5 MiB are small things that live on, two beams are on their way.
    """
    before, full, freed, after, again, later = _said(_BEAMS)
    assert full > before + 150
    assert freed > before + 100
    assert max(after, again, later) < before + 24
