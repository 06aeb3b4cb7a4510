"""Files of recorders: when the disk holds too little."""

from __future__ import annotations

import errno
from collections import Counter
from pathlib import Path

import pytest

from msgs.values.diagnostics import TopicCount
from nodes.recording.files import TopicLoss, losses_between, require_kept_free


def test_what_is_to_stay_free_may_be_all_that_is_left() -> None:
    """10 MB free: a file that grows by 4 MB leaves 6 MB, which is enough for 6 MB; a byte more is too much."""
    path = Path("a.mcap")
    require_kept_free(path, kept_bytes=6_000_000, growth_bytes=4_000_000, free=10_000_000)
    with pytest.raises(OSError, match=r"10 MB free, 4\.1 MB are needed to finish the file and 6 MB are to") as caught:
        require_kept_free(path, kept_bytes=6_000_000, growth_bytes=4_000_001, free=10_000_000)
    assert (caught.value.errno, caught.value.filename) == (errno.ENOSPC, "a.mcap")


def count(lost: int, rejected: int = 0, outdated: int = 0) -> TopicCount:
    return TopicCount(topic="log", messages=9, bytes=9, lost=lost, rejected=rejected, outdated=outdated)


def test_losses_are_those_since_the_recording_began() -> None:
    """3 were lost before and 5 are at its end: 2 of them are the recording's; so with the rejected and the outdated."""
    losses = losses_between([count(3, 1, 10)], [count(5, 4, 14)], Counter({"log": 7}))
    assert losses.topics == (TopicLoss(topic="log", lost=2, rejected=3, outdated=4, missed=7),)
    assert losses_between([count(3)], [count(3)]).topics == ()
