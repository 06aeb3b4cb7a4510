"""A run of many jobs that goes on where it was stopped."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from lab.studies.resumable import ResumableRun, charged


class Numbers(msgspec.Struct, frozen=True):
    a: int


def test_a_run_goes_on_with_what_is_missing(tmp_path: Path) -> None:
    """Three jobs, the second done: two are missing, one is ticked; results come in the order of the jobs."""
    files = {"x": "x.json", "y": "deep/y.bin", "z": "z.json"}
    tmp_path = tmp_path / "of" / "today"
    run: ResumableRun[str, Numbers] = ResumableRun(Numbers(1), tmp_path, Numbers, files)
    ticks: list[int] = []
    assert run.missing() == ["x", "y", "z"]
    run.keep("y", Numbers(5))
    again: ResumableRun[str, Numbers] = ResumableRun(Numbers(1), tmp_path, Numbers, files)
    assert again.missing(lambda: ticks.append(1)) == ["x", "z"]
    assert len(ticks) == 1
    again.keep("z", Numbers(7))
    again.keep("x", Numbers(3))
    assert [result.a for result in again.results()] == [3, 5, 7]
    assert (tmp_path / "x.json").read_bytes() == b'{"a":3}'
    (tmp_path / "z.json").write_bytes(b"{")
    with pytest.raises(ValueError, match=r"z\.json: .*without this file its job is done again"):
        again.results()
    with pytest.raises(ValueError, match=r"plan\.json: out must be a new folder or hold the same run"):
        ResumableRun(Numbers(2), tmp_path, Numbers, files)


def test_what_fails_is_charged_to_its_rows() -> None:
    failed = {"a": "before"}
    with charged(failed, "b", "c"):
        raise ValueError("no such file")
    with charged(failed, "d"):
        pass
    assert failed == {"a": "before", "b": "no such file", "c": "no such file"}
