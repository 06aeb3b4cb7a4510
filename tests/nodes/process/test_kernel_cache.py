"""Compiled kernels have a place anywhere: the user's own where home and installation are shut."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from msgs.files.shipped import CHECKOUT
from nodes.process import kernel_cache
from nodes.process.kernel_cache import VARIABLE, can_write, fallback_folder, use_fallback


def test_numba_decides_where_it_finds_a_place(tmp_path: Path) -> None:
    home = {"XDG_CACHE_HOME": str(tmp_path)}
    assert fallback_folder(home, lambda folder: folder == CHECKOUT) is None
    assert fallback_folder(home, lambda folder: folder == tmp_path) is None
    assert fallback_folder(home | {VARIABLE: "/kernels"}, lambda folder: False) is None


def test_a_folder_that_is_not_there_is_judged_by_the_one_above(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Asked of the system itself: to root everything is writable."""
    monkeypatch.setattr(kernel_cache.os, "access", lambda folder, mode: folder == tmp_path)
    assert can_write(tmp_path / "a" / "b")
    assert not can_write(tmp_path.parent)


def test_without_a_place_it_is_the_users_own_and_shut_to_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kernel_cache.tempfile, "gettempdir", lambda: str(tmp_path))
    monkeypatch.setenv(VARIABLE, "")
    folder = fallback_folder({}, lambda folder: False)
    assert folder == tmp_path / f"mirrorwave-{os.getuid()}" / "kernels"
    monkeypatch.setattr(kernel_cache, "fallback_folder", lambda environment: folder)
    use_fallback()
    assert os.environ[VARIABLE] == str(folder)
    assert folder.stat().st_mode & 0o777 == 0o700
    folder.chmod(0o777)
    with pytest.raises(ValueError, match="others may write into it"):
        use_fallback()
