"""Memory that only the start of a process needed, given back to the machine."""

from __future__ import annotations

import contextlib
import ctypes
import mmap
import re
from collections import deque
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

#: Two beams, one on its way and one at work: free heap that has grown by more is given back once it has been free for
#: so many looks.
GROWN_BYTES, LOOKS = 8 << 20, 4
_MADV_DONTNEED = 4
_MALLOC_INFO = [
    "arena",
    "ordblks",
    "smblks",
    "hblks",
    "hblkhd",
    "usmblks",
    "fsmblks",
    "uordblks",
    "fordblks",
    "keepcost",
]
_HEAD = re.compile(r"([0-9a-f]+)-([0-9a-f]+) (\S{4}) \S+ \S+ \d+\s*(.*)")
_SIZES = ("Rss", "Pss", "Anonymous")


class Mapping(NamedTuple):
    """A range of a process's addresses: what it maps and how much of it is in memory, in bytes.

    `anonymous`: pages of its own, which no file holds.
    """

    start: int
    end: int
    access: str
    path: str
    rss: int
    pss: int
    anonymous: int


def mappings(pid: int | str = "self") -> list[Mapping]:
    """Return the mappings of a process, in order of address; `OSError` if it has ended or is another user's."""
    with open(f"/proc/{pid}/smaps", encoding="utf-8", errors="replace") as lines:
        return list(parse_smaps(lines))


def parse_smaps(lines: Iterable[str]) -> Iterator[Mapping]:
    """Yield the mappings of `/proc/PID/smaps` (proc_pid_smaps(5))."""
    head: re.Match[str] | None = None
    sizes: dict[str, int] = {}
    for line in lines:
        if match := _HEAD.match(line):
            if head is not None:
                yield _mapping(head, sizes)
            head, sizes = match, {}
        else:
            name, _, value = line.partition(":")
            if name in _SIZES:
                sizes[name] = int(value.split()[0]) << 10
    if head is not None:
        yield _mapping(head, sizes)


def _mapping(head: re.Match[str], sizes: dict[str, int]) -> Mapping:
    start, end, access, path = head.groups()
    return Mapping(int(start, 16), int(end, 16), access, path, *(sizes.get(name, 0) for name in _SIZES))


def release_unused() -> None:
    """Return free heap, and pages of libraries that are as in their files: what still runs is mapped again from there.

    Code that only the start ran, such as the compiler's, is then no longer counted to this process. It stays in the
    page cache as long as the machine has room.
    """
    trim_heap()
    libc = ctypes.CDLL(None)
    with contextlib.suppress(OSError):
        for item in mappings():
            if is_as_in_file(item):
                libc.madvise(ctypes.c_void_p(item.start), ctypes.c_size_t(item.end - item.start), _MADV_DONTNEED)


class FreeHeap:
    """Free heap of this process, given back whenever it has grown: by beams that waited while others had the processor.

    glibc keeps what is freed, up to `MALLOC_TRIM_THRESHOLD_` at the end of a heap and without limit within it. What was
    given back it still counts as free, so that beams which come and go between two looks would pass unseen: counted are
    pages in memory that nothing uses.
    """

    def __init__(self) -> None:
        self._kept_bytes = unused_bytes()
        self._looks: deque[int] = deque(maxlen=LOOKS)

    def give_back(self) -> None:
        """Look, and give free heap back if in the last `LOOKS` there was always `GROWN_BYTES` more than once."""
        unused = unused_bytes()
        self._looks.append(unused)
        self._kept_bytes = min(self._kept_bytes, unused)
        if len(self._looks) == LOOKS and min(self._looks) > self._kept_bytes + GROWN_BYTES:
            trim_heap()
            self._looks.clear()
            self._kept_bytes = unused_bytes()


class _MallocInfo(ctypes.Structure):
    """What the C library says of its heap."""

    _fields_ = [(name, ctypes.c_size_t) for name in _MALLOC_INFO]


def unused_bytes() -> int:
    """Return how much memory of this process is in pages that no file holds and that its heap does not use.

    0 where the system does not say.
    """
    mallinfo2 = getattr(ctypes.CDLL(None), "mallinfo2", None)
    if mallinfo2 is None:
        return 0
    mallinfo2.restype = _MallocInfo
    heap = mallinfo2()
    _, resident, shared, *_ = map(int, Path("/proc/self/statm").read_text("ascii").split())
    return int((resident - shared) * mmap.PAGESIZE - heap.uordblks - heap.hblkhd)


def trim_heap() -> None:
    """Return free heap to the machine, where the C library can."""
    malloc_trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if malloc_trim is not None:
        malloc_trim(ctypes.c_size_t(0))


def is_as_in_file(item: Mapping) -> bool:
    """Return whether dropping a mapping's pages loses nothing: a file's, read only, none of them changed."""
    return item.access in ("r-xp", "r--p") and Path(item.path).is_absolute() and item.anonymous == 0 and item.rss > 0
