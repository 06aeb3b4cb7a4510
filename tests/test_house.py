"""The laws of the house: imports only run down, torch stays in its two rooms, models know no bus."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FLOORS = {"msgs": 1, "models": 2, "sim_player": 3, "nodes": 4, "mirrorwave": 5}
#: Modules of floor 1 that hold values only; floors 2 and 3 may use these and no other.
VALUES = {"msgs.units", "msgs.arrays", "msgs.frames", "msgs.radar", "msgs.vehicle", "msgs.perception"}
ROOMS = {
    "models.physics": {"models.physics"},
    "models.vehicle": {"models.vehicle"},
    "models.perception": {"models.perception", "models.physics"},
    "models.networks": {"models.networks"},
    "models.training": {"models.training", "models.perception", "models.physics", "models.networks"},
}
TORCH_ROOMS = ("models.networks", "models.training")
SOURCES = sorted(path for floor in FLOORS for path in (ROOT / floor).rglob("*.py"))


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported_modules(source: str) -> list[str]:
    """Every module that a source imports, anywhere in it (lazy imports included)."""
    found: list[str] = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            # "from models.physics import mirror" imports models.physics.mirror
            found += [f"{node.module}.{alias.name}" for alias in node.names]
    return found


def room_of(module: str) -> str | None:
    return next((room for room in ROOMS if module == room or module.startswith(room + ".")), None)


def violations(module: str, imports: list[str]) -> list[str]:
    """Broken laws of one module, in words."""
    floor = FLOORS[module.split(".")[0]]
    found = []
    for imported in imports:
        root = imported.split(".")[0]
        if root == "torch" and not module.startswith(TORCH_ROOMS):
            found.append(f"{module} imports torch; only {' and '.join(TORCH_ROOMS)} may")
        if root not in FLOORS:
            continue
        if FLOORS[root] > floor:
            found.append(f"{module} (floor {floor}) imports {imported} (floor {FLOORS[root]}): imports run down")
        is_value = any(imported == value or imported.startswith(value + ".") for value in VALUES)
        if root == "msgs" and floor in (2, 3) and not is_value:
            found.append(f"{module} imports {imported}; floors 2 and 3 take only values from msgs")
        room, target = room_of(module), room_of(imported)
        if room and target and target not in ROOMS[room]:
            found.append(f"{module} imports {imported}; {room} may use {sorted(ROOMS[room])}")
    return found


@pytest.mark.parametrize("path", SOURCES, ids=module_name)
def test_imports_run_down(path: Path) -> None:
    assert violations(module_name(path), imported_modules(path.read_text())) == []


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("msgs.codec", "import models.physics.mirror"),
        ("models.physics.mirror", "from msgs.zmq_bus import ZmqBus"),
        ("sim_player.player", "from msgs import codec"),
        ("models.perception.peaks", "from models.training import losses"),
        ("models.physics.mirror", "from models.perception import walls"),
        ("nodes.geometry", "def late():\n    import torch"),
        ("nodes.geometry", "import mirrorwave.cli"),
    ],
)
def test_the_law_catches_a_breach(module: str, source: str) -> None:
    assert violations(module, imported_modules(source))


def test_supervisor_imports_no_process_of_the_graph() -> None:
    """A launch file names modules; the supervisor must not pull numba, onnxruntime or a scene into its own process."""
    heavy = {"nodes.ra_former", "nodes.player", "nodes.geometry", "nodes.dense_predictor"}
    imports = imported_modules((ROOT / "nodes" / "supervisor.py").read_text())
    assert not {name for name in imports for node in heavy if name.startswith(node)}


@pytest.mark.parametrize("path", SOURCES, ids=module_name)
def test_no_forbidden_words(path: Path) -> None:
    """No pickle, eval, exec, exit or print in the four floors below the command line."""
    forbidden = (
        {"eval", "exec", "exit", "print"} if path.relative_to(ROOT).parts[0] != "mirrorwave" else {"eval", "exec"}
    )
    calls = [
        node.func.id
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in forbidden
    ]
    assert calls == []
    assert "pickle" not in {name.split(".")[0] for name in imported_modules(path.read_text())}


def test_launch_is_data() -> None:
    """`launch/` holds YAML: ROS 2 owns the import name."""
    assert not list((ROOT / "launch").rglob("*.py"))


def test_topics_name_each_message_once() -> None:
    from msgs.topics import TOPICS

    assert len({topic.type for topic in TOPICS.values()}) == len(TOPICS)
    for topic in TOPICS.values():
        assert topic.history_bytes >= topic.max_bytes >= 1024, topic.name
