"""Collects the hard cases that ran; `--stability-page FILE` writes them down (`make stability`)."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.stability.catalogue import Case, Errors, write_page

CASES = pytest.StashKey[list[Case]]()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--stability-page", type=Path, help="Write all hard cases with their errors to this file.")


def pytest_configure(config: pytest.Config) -> None:
    config.stash[CASES] = []


@pytest.fixture
def errors(request: pytest.FixtureRequest) -> Errors:
    """Takes the two errors of the case that asks for it."""
    marker = request.node.get_closest_marker("hard")
    assert marker is not None, "a case that reports errors needs the marker `hard`"

    def take(*, naive: float, ours: float) -> None:
        why = (request.function.__doc__ or "").strip().split("\n\n")[0]
        where, naive_form, bound, unit, source = marker.args
        case = Case(
            request.path.stem.removeprefix("test_"), request.node.name.removeprefix("test_").replace("_", " "),
            " ".join(why.split()), where, naive_form, float(naive), float(ours), float(bound), unit, source,
        )  # fmt: skip
        case.hold()
        request.config.stash[CASES].append(case)

    return take


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    path, cases = config.getoption("--stability-page", default=None), config.stash[CASES]
    if path is None:
        return
    for case in sorted(cases, key=lambda case: (case.family, case.name)):
        terminalreporter.write_line(
            f"{case.family:12s} {case.name:80.80s} naive {case.naive:8.1e}  ours {case.ours:8.1e}  "
            f"bound {case.bound:8.1e} {case.unit}"
        )
    write_page(cases, path)
    terminalreporter.write_line(f"{path}: {len(cases)} cases")
