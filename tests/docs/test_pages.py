"""Every command block of README and guides is run: `tests/docs/pages.py` says how, `SHORTER` what is shortened.

Of other pages every command of ours must be one that its verb takes.
"""

from __future__ import annotations

import re
import shlex
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from _pytest.mark import ParameterSet

from mirrorwave.cli import main
from tests.docs.pages import ROOT, SHORTER, Runner, blocks_of, commands_of, shortened
from tests.docs.prepared import Prepared, remember_trials, speaking_car

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs" / "guides").glob("*.md"))]
OTHERS = sorted(set((ROOT / "docs").glob("**/*.md")) - set(PAGES))
#: Files of the reader's own that a page speaks of.
GIVEN: dict[str, tuple[str, ...]] = {
    "docs/guides/connect-my-car.md": ("drive.log", "car.dbc", "car.yaml"),
    "docs/guides/connect-my-radar.md": ("capture.bin", "chirps.cfg", "detections.csv"),
    "docs/guides/first-look.md": ("corner.mcap",),
    "docs/guides/recordings.md": ("seen.mcap",),
    "docs/guides/train-on-my-captures.md": ("truth",),
    "docs/guides/use-from-code.md": ("seen.mcap", "corner.mcap"),
    "docs/guides/watch-a-graph.md": ("drive.log", "seen.mcap"),
}
#: Pages that speak of a graph that runs already.
OF_A_GRAPH = {"docs/guides/two-machines.md"}
LIVE = re.compile(r"launch [^#\n]*(&|--record)")
#: What of the checkout a page finds beside it.
CHECKOUT = (
    "launch", "docs", "examples", "benchmarks", "models", "msgs", "nodes", "sim_player", "mirrorwave", "tests",
    "Makefile", "pyproject.toml", "requirements.lock", "requirements-dev.lock",
)  # fmt: skip


@pytest.fixture(scope="session")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Prepared:
    return Prepared(tmp_path_factory.mktemp("prepared"))


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A reader's folder: the checkout's files, nothing of other pages, a graph of its own."""
    for name in CHECKOUT:
        (tmp_path / name).symlink_to(ROOT / name)
    # a short path: socket names are limited
    with tempfile.TemporaryDirectory(prefix="mw") as path:
        monkeypatch.delenv("MIRRORWAVE_RUN_DIR", raising=False)
        monkeypatch.setenv("XDG_RUNTIME_DIR", path)
        # whether a budget can be held is a matter of the machine, and of what else it does
        monkeypatch.setenv("XDG_CACHE_HOME", path)
        remember_trials(expected_ms=50.0)
        yield tmp_path


@pytest.fixture(scope="session")
def launched() -> dict[str, Path | None]:
    # in the background of several pages; its recording is lent to those that record it
    return {"launch/corner.yaml": Path("seen.mcap")}


def pages_with_code() -> Iterator[ParameterSet]:
    for page in PAGES:
        name = str(page.relative_to(ROOT))
        blocks = blocks_of(page)
        if blocks:
            text = "\n".join(block.text for block in blocks)
            # asks a living graph or counts what it lost: wants the machine to itself
            is_live = name in OF_A_GRAPH or LIVE.search(text)
            yield pytest.param(name, marks=[pytest.mark.graph] if is_live else [])


@pytest.mark.parametrize("name", list(pages_with_code()))
def test_page(name: str, folder: Path, prepared: Prepared, launched: dict[str, Path | None]) -> None:
    for given in GIVEN.get(name, ()):
        prepared.lend(given, folder)
    runner = Runner(folder, launched)
    graph = "mirrorwave launch launch/corner.yaml &" if name in OF_A_GRAPH else ""
    with speaking_car(), runner.beside(graph):
        runner.run_page(blocks_of(ROOT / name))
    if runner.missing:
        pytest.skip(f"all but what needs {', '.join(runner.missing)}, which this machine lacks")


def test_other_pages_name_verbs_and_options_that_exist(capsys: pytest.CaptureFixture[str]) -> None:
    """`--help` behind a command's own words: an unknown verb or option is refused before it is heard."""
    asked = 0
    for page in OTHERS:
        shells = [block for block in blocks_of(page) if block.language == "sh"]
        for block in shells:
            for line, command in commands_of(block.text):
                words = shlex.split(re.split(r" [&|>]", command.rstrip("& "))[0])
                if words[:1] == ["mirrorwave"]:
                    asked += 1
                    code = main([*words[1:], "--help"])
                    assert code == 0, f"{page.name}:{block.line + line}: {command}: {capsys.readouterr().err}"
    assert asked > 5


def test_every_shortening_is_used() -> None:
    """One that no command needs any more would hide the next command that it fits."""
    commands = [
        command
        for page in PAGES
        for block in blocks_of(page)
        if block.language == "sh"
        for _, command in commands_of(block.text)
    ]
    assert len(commands) > 50
    used = {number for command in commands for number in _used(command)}
    assert used == set(range(len(SHORTER)))


def _used(command: str) -> Iterator[int]:
    for number, (pattern, replacement) in enumerate(SHORTER):
        changed = re.sub(pattern, replacement, command.rstrip("& "))
        if changed != command.rstrip("& "):
            yield number
        command = changed


def test_comments_continued_lines_and_activation() -> None:
    text = (
        "source .venv/bin/activate\n# words\nmirrorwave top \\\n    --once   # now\n\nmirrorwave sim run 'a b.yaml' &\n"
    )
    assert list(commands_of(text)) == [(3, "mirrorwave top --once"), (6, "mirrorwave sim run 'a b.yaml' &")]


def test_short_forms() -> None:
    assert shortened("make test") == "make -n test"
    assert shortened("mirrorwave top") == "mirrorwave top --once --window 1"
    assert shortened("mirrorwave topic hz radar/beam") == "mirrorwave topic hz radar/beam --duration 1"
    assert shortened("mirrorwave sim effects launch/scenes/corner.yaml") == (
        "mirrorwave sim effects launch/scenes/corner.yaml"
    )
