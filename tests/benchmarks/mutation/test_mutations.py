"""The mutation testing itself: on a small tree of its own, and the committed list against the sources."""

from __future__ import annotations

import ast
from pathlib import Path

import msgspec
import pytest

from benchmarks.mutation.mutations import (
    ROOT,
    Mutation,
    as_json,
    digest_of,
    first_failed,
    known_verdicts,
    load_list,
    mutated,
    run,
    stages_of,
    summary,
)

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
    files["pytest.ini"] = "[pytest]\naddopts = --import-mode=importlib\nmarkers = graph\n"
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
    tree too kills nothing and is named, and the tree stays what it is.
    """
    log, judged = tmp_path / "log" / "mutations.jsonl", list[str]()
    before = {path: path.read_bytes() for path in tree.rglob("*.py")}
    verdicts = run([KILLED, SURVIVES], log, tree, jobs=2, limit_s=600.0, on_verdict=lambda one: judged.append(one.name))
    verdicts += run([ENDLESS], log, tree, limit_s=2.0)
    assert [(one.status, one.killed_by) for one in verdicts] == [
        ("killed", "tests/test_shapes.py::test_area"), ("survived", ""), ("timed out", ""),
    ]  # fmt: skip
    assert [one.unfit for one in verdicts] == [(), ("tests/test_shapes.py::test_that_never_passes",), ()]
    assert sorted(judged) == ["exchanged", "sum"]
    assert summary(verdicts) == {"reviewed": {"killed": 1, "survived": 1, "timed out": 1}}
    assert {path: path.read_bytes() for path in tree.rglob("*.py")} == before
    row = msgspec.json.decode(as_json([KILLED], verdicts[:1]))["mutations"][0]
    assert (row["status"], row["killed_by"]) == ("killed", "tests/test_shapes.py::test_area")


@pytest.mark.slow
def test_verdicts_hold_until_something_they_hang_on_changes(tree: Path, tmp_path: Path) -> None:
    """A survivor is not judged again, though the log's last line was cut; of a new test that imports its module only
    that is run, and it kills. Time that is up stays up, unless more of it is given.
    """
    log = tmp_path / "mutations.jsonl"
    (first,) = run([SURVIVES], log, tree)
    with log.open("ab") as stream:
        stream.write(b'{"name":"exch')
    size = log.stat().st_size
    assert run([SURVIVES], log, tree) == [first]
    assert log.stat().st_size == size + 1
    (tree / "tests" / "test_order.py").write_text(
        "import inspect\n\nfrom models.shapes import area\n\n\n"
        "def test_order():\n    assert 'width * height' in inspect.getsource(area)\n"
    )
    (second,) = run([SURVIVES], log, tree)
    assert (second.status, second.killed_by) == ("killed", "tests/test_order.py::test_order")
    assert second.ran == (*first.ran, "tests/test_order.py")
    assert run([SURVIVES], log, tree) == [second]
    over = msgspec.structs.replace(first, status="timed out", ran=(), seconds=5.0, digest=digest_of(tree, SURVIVES, ()))
    log.write_bytes(msgspec.json.encode(over))
    assert [known_verdicts([SURVIVES], log, tree, limit)["exchanged"].status for limit in (5.0, 6.0)] == [
        "timed out", "unknown",
    ]  # fmt: skip


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
        assert one.group == "guard" or next(stages_of(ROOT, one)) != ["tests/stability"], one.name


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
