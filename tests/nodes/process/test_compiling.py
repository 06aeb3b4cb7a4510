"""The word on kernels that are compiled."""

from __future__ import annotations

import pytest
from numba import njit

from nodes.process import compiling
from nodes.process.compiling import NOTICE, compile_notice


def test_compiling_is_said_once_and_what_is_there_is_silent() -> None:
    @njit
    def twice(value):  # type: ignore[no-untyped-def]
        return 2 * value

    @njit
    def outer(value):  # type: ignore[no-untyped-def]
        return twice(value) + 1

    said: list[str] = []
    with compile_notice(said.append):
        assert said == []
        assert outer(3) == 7
        assert said == [NOTICE]
    with compile_notice(said.append):
        assert outer(4) == 9
    assert said == [NOTICE]
    assert outer(1.5) == 4.0
    assert said == [NOTICE]


def test_long_compiling_is_said_again_with_what_is_done(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two kernels the second is compiled while the first is."""
    monkeypatch.setattr(compiling, "BEAT_S", 0.0)

    @njit
    def inner(value):  # type: ignore[no-untyped-def]
        return 3 * value

    @njit
    def outer(value):  # type: ignore[no-untyped-def]
        return inner(value)

    said: list[str] = []
    with compile_notice(said.append):
        assert outer(3) == 9
        assert inner(1.5) == 4.5
    lines = [text.rpartition(", ")[0] for text in said[1:]]
    assert (said[0], lines) == (NOTICE, ["compiling kernels: 0 done", "compiling kernels: 2 done"])
