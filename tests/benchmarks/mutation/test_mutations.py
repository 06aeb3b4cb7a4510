"""The mutation testing itself: on a small tree of its own, and the committed list against the sources."""

from __future__ import annotations

import ast
from pathlib import Path

import msgspec
import pytest

from benchmarks.mutation.mutations import ROOT, Mutation, first_failed, load_list, mutated, run, stages_of

SOURCE = """def area(width, height):
    return width * height


def wait(limit):
    while limit > 0:
        limit -= 1
    return limit
"""
TEST = """import pytest

from models.shapes import area, wait


def test_area():
    assert area(3, 4) == 12


def test_wait():
    assert wait(3) == 0


def test_that_never_passes():
    assert area(1, 1) == 2
"""


@pytest.fixture
def tree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A module with a test file, one test of which fails whatever the module does."""
    files = {"models/__init__.py": "", "models/shapes.py": SOURCE, "tests/test_shapes.py": TEST}
    files["pytest.ini"] = "[pytest]\naddopts = --import-mode=importlib\n"
    for name, text in files.items():
        (tmp_path / "tree" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "tree" / name).write_text(text)
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
    return tmp_path / "tree"


def mutation(name: str, old: str, new: str) -> Mutation:
    return Mutation(name=name, file="models/shapes.py", old=old, new=new, reason="", group="reviewed")


KILLED = mutation("sum", "width * height", "width + height")
SURVIVES = mutation("exchanged", "width * height", "height * width")
ENDLESS = mutation("endless", "limit -= 1", "limit += 1")


@pytest.mark.slow
def test_a_mutant_is_killed_survives_or_runs_out_of_time(tree: Path, tmp_path: Path) -> None:
    """3 + 4 is not 12; the factors may be exchanged; counting upwards never ends. The test that fails in the unchanged
    tree too kills nothing, the tree stays what it is, and what the log has is not judged again.
    """
    log = tmp_path / "log" / "mutations.jsonl"
    before = {path: path.read_bytes() for path in tree.rglob("*.py")}
    verdicts = run([KILLED, SURVIVES], log, tree) + run([ENDLESS], log, tree, limit_s=2.0)
    assert [(one.status, one.killed_by) for one in verdicts] == [
        ("killed", "tests/test_shapes.py::test_area"), ("survived", ""), ("timed out", ""),
    ]  # fmt: skip
    assert {path: path.read_bytes() for path in tree.rglob("*.py")} == before
    size = log.stat().st_size
    assert run([KILLED, SURVIVES, ENDLESS], log, tree) == verdicts
    assert log.stat().st_size == size


def test_what_does_not_fit_its_file_is_refused_before_any_test(tree: Path, tmp_path: Path) -> None:
    twice = mutation("twice", "limit", "count")
    with pytest.raises(ValueError, match=r"models/shapes\.py: text of 'twice' must stand once, stands 4 times"):
        run([KILLED, twice], tmp_path / "log", tree)
    assert not (tmp_path / "log").exists()
    (tmp_path / "list.yaml").write_bytes(msgspec.yaml.encode([KILLED, KILLED]))
    with pytest.raises(ValueError, match=r"list\.yaml: names must differ, 'sum' repeats"):
        load_list(tmp_path / "list.yaml")


def test_every_mutation_of_the_list_fits_its_file() -> None:
    """Its text stands there once, the mutant is another program that Python reads, and its tests exist."""
    programs: dict[str, str] = {}
    for one in load_list():
        source = (ROOT / one.file).read_text()
        program = programs.setdefault(one.file, ast.dump(ast.parse(source)))
        assert ast.dump(ast.parse(mutated(source, one))) != program, one.name
        assert all((ROOT / test.partition("::")[0]).exists() for test in one.tests), one.name
        assert one.tests or next(stages_of(ROOT, one)), one.name


@pytest.mark.parametrize(
    "name",
    [
        "tests/test_shapes.py::test_area",
        "tests/test_shapes.py::test_area[3-must be > 0 - or none]",
        "tests/test_shapes.py::test_area[width [m] must exceed 0]",
        "tests/test_shapes.py",
    ],
)
def test_the_name_of_a_failed_test_may_hold_spaces(name: str) -> None:
    for end in (f"{name} - assert 3 == 12", f"{name} - KeyError: 'a [b] - c'", name):
        assert first_failed(f".F\n== short test summary info ==\nFAILED {end}\n1 failed in 0.1s") == name
    assert first_failed("1 passed in 0.1s") == ""
