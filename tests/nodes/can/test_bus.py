"""What a DBC may hold before it is parsed."""

from __future__ import annotations

import pytest

from nodes.can.bus import MAX_MESSAGE_BYTES, _refuse_long_messages


@pytest.mark.parametrize(
    ("text", "got"),
    [
        ("BO_ 1 A: 1785 X", None),
        ("BO_ 1 A: 1786 X", "1786"),
        ("BO_ 1 A: -1 X", "-1"),
        # 14272 + 8 bits are 1785 bytes, one bit more begins the next
        ("BO_ 1 A: 8 X\n SG_ s : 14272|8@1+ (1,0) [0|0] V", None),
        ("BO_ 1 A: 8 X\n SG_ s : 14272|9@1+ (1,0) [0|0] V", "1786"),
        ("BO_ 1 A: 8 X\n SG_ s : 0|-4@1+ (1,0) [0|0] V", "-4"),
        # what is commented out is none
        ("BO_ 1 A: 8 X // BO_ 2 B: 9999 X", None),
        ("", None),
    ],
)
def test_messages_longer_than_any_bus_carries_are_refused(text: str, got: str | None) -> None:
    assert MAX_MESSAGE_BYTES == 1785
    if got is None:
        _refuse_long_messages(text)
        return
    with pytest.raises(ValueError, match=rf"messages must be of 0\.\.1785 bytes, got {got}$"):
        _refuse_long_messages(text)
