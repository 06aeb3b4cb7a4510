"""Files of recorders: when the disk holds too little."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from nodes.recording.files import require_kept_free


def test_what_is_to_stay_free_may_be_all_that_is_left() -> None:
    """10 MB free: a file that grows by 4 MB leaves 6 MB, which is enough for 6 MB; a byte more is too much."""
    path = Path("a.mcap")
    require_kept_free(path, kept_bytes=6_000_000, growth_bytes=4_000_000, free=10_000_000)
    with pytest.raises(OSError, match="10 MB free, 6 MB are to stay free") as caught:
        require_kept_free(path, kept_bytes=6_000_000, growth_bytes=4_000_001, free=10_000_000)
    assert (caught.value.errno, caught.value.filename) == (errno.ENOSPC, "a.mcap")
