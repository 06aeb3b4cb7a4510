"""Which share of the machine a process may use, and what its processor computes whole numbers with."""

from __future__ import annotations

import platform
from pathlib import Path

import pytest

from nodes.process.machine import integer_kernels, quota_cores


@pytest.fixture
def groups(tmp_path: Path) -> Path:
    """A tree of control groups; what it limits is written by each test."""
    (tmp_path / "box" / "inner").mkdir(parents=True)
    (tmp_path / "cpu,cpuacct" / "box").mkdir(parents=True)
    return tmp_path


def quota(groups: Path, memberships: str) -> float | None:
    (groups / "memberships").write_text(memberships)
    return quota_cores(groups / "memberships", groups)


def test_the_tightest_quota_of_the_control_groups_above_counts(groups: Path) -> None:
    assert quota(groups, "0::/box/inner\n") is None
    (groups / "box" / "cpu.max").write_text("150000 100000\n")
    (groups / "box" / "inner" / "cpu.max").write_text("max 100000\n")
    assert quota(groups, "0::/box/inner\n") == 1.5
    # what a container sees of its own group
    (groups / "cpu.max").write_text("50000 100000\n")
    assert quota(groups, "0::/\n") == 0.5
    assert quota(groups, "0::/box/inner\n") == 0.5


def test_quotas_of_the_earlier_version_count_too(groups: Path) -> None:
    folder = groups / "cpu,cpuacct" / "box"
    memberships = "5:memory:/box\n4:cpu,cpuacct:/box\n0::/\n"
    (folder / "cpu.cfs_period_us").write_text("100000\n")
    (folder / "cpu.cfs_quota_us").write_text("-1\n")
    assert quota(groups, memberships) is None
    (folder / "cpu.cfs_quota_us").write_text("25000\n")
    assert quota(groups, memberships) == 0.25


@pytest.mark.parametrize(
    ("line", "kernels"),
    [
        ("flags\t\t: fpu sse4_1 avx2 avx512f avx512_vnni", "AVX-512 VNNI"),
        ("flags\t\t: fpu sse4_1 avx2 avx_vnni", "AVX VNNI"),
        ("flags\t\t: fpu sse4_1 avx2", "AVX2"),
        ("Features\t: fp asimd asimddp", "ARM dot product"),
        ("flags\t\t: fpu sse4_1", f"{platform.machine()} alone"),
        ("", f"{platform.machine()} alone"),
    ],
)
def test_kernels_of_whole_numbers_are_the_best_that_the_processor_names(
    tmp_path: Path, line: str, kernels: str
) -> None:
    (tmp_path / "cpuinfo").write_text(f"processor\t: 0\nmodel name\t: any\n{line}\nbugs\t\t: none\n")
    assert integer_kernels(tmp_path / "cpuinfo") == kernels
