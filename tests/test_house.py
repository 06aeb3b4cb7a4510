"""The laws of the house: imports only run down, torch stays in its two rooms, no floor knows the lab."""

from __future__ import annotations

import ast
import functools
import os
import pwd
import subprocess
import sys
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import pytest

from msgs.files.shipped import CHECKOUT
from tests.home import FOLDERS, VARIABLE
from tests.test_vocabulary import retired, retired_names

ROOT = CHECKOUT
FLOORS = {"msgs": 1, "models": 2, "sim_player": 3, "nodes": 4, "mirrorwave": 5, "lab": 6, "contrib": 7}
#: What verbs of the command line import late, inside their functions; all else is named there and imported by nobody.
BESIDE = ("lab", "contrib")
#: Rooms of floor 1 that know no bus; floors 2 and 3 may use these and no other.
VALUES = ("msgs.values", "msgs.files")
#: What each room of `models`, and that of the networks, may import of the others.
ROOMS = {
    "models.physics": {"models.physics"},
    "models.vehicle": {"models.vehicle"},
    "models.scores": {"models.scores", "models.physics"},
    "models.perception": {"models.perception", "models.physics"},
    "lab.networks": {"lab.networks"},
}
#: Rooms of the simulator, each of which knows those before it alone.
WORLD = (
    *("bodies", "scene", "maps", "generate", "trace", "signal", "effects", "paths", "planner", "drive", "player"),
    *("lidar", "dataset"),
)
#: Python files in one folder, `__init__.py` apart.
MAX_FILES = 15
TORCH_ROOMS = ("lab.networks", "lab.training")
SOURCES = sorted(path for floor in FLOORS for path in (ROOT / floor).rglob("*.py"))


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@functools.cache
def source_of(path: Path) -> str:
    return path.read_text()


# the trees of all modules at once would be looked through for garbage again and again
@functools.lru_cache(maxsize=1)
def parsed(source: str) -> ast.Module:
    return ast.parse(source)


@functools.lru_cache(maxsize=1)
def nodes_of(source: str) -> list[ast.AST]:
    return list(ast.walk(parsed(source)))


@functools.cache
def imported_modules(source: str) -> tuple[str, ...]:
    """Every module that a source imports, anywhere in it (lazy imports included)."""
    found: list[str] = []
    for node in nodes_of(source):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            # "from models.physics import mirror" imports models.physics.mirror
            found += [f"{node.module}.{alias.name}" for alias in node.names]
    return tuple(found)


def room_of(module: str) -> str | None:
    return next((room for room in ROOMS if module == room or module.startswith(room + ".")), None)


def world_room(module: str) -> str | None:
    """Room of the simulator that a module is in, if it is in one."""
    parts = module.split(".")
    return parts[1] if parts[0] == "sim_player" and len(parts) > 1 and parts[1] in WORLD else None


def early_plug_ins(source: str) -> list[str]:
    """What a module imports of the laboratory or of a plug-in as soon as it is imported itself."""
    late = {
        id(inner)
        for node in ast.walk(parsed(source))
        if isinstance(node, ast.FunctionDef) or (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")
        for inner in ast.walk(node)
    }
    early = [node for node in ast.walk(parsed(source)) if isinstance(node, ast.Import | ast.ImportFrom)]
    names = [name for node in early if id(node) not in late for name in imported_modules(ast.unparse(node))]
    return [f"imports {name} at once" for name in names if name.split(".")[0] in BESIDE]


def violations(module: str, imports: Iterable[str]) -> list[str]:
    """Broken laws of one module, in words."""
    floor = FLOORS[module.split(".")[0]]
    found = []
    for imported in imports:
        root = imported.split(".")[0]
        if root == "torch" and not module.startswith(TORCH_ROOMS):
            found.append(f"{module} imports torch; only {' and '.join(TORCH_ROOMS)} may")
        if root not in FLOORS:
            continue
        late = module.startswith("mirrorwave.commands.") and root in BESIDE
        if FLOORS[root] > floor and not late:
            found.append(f"{module} (floor {floor}) imports {imported} (floor {FLOORS[root]}): imports run down")
        is_value = imported.startswith(VALUES)
        if root == "msgs" and floor in (2, 3) and not is_value:
            found.append(f"{module} imports {imported}; floors 2 and 3 take only values from msgs")
        here, there = world_room(module), world_room(imported)
        if here and there and WORLD.index(there) > WORLD.index(here):
            found.append(f"{module} imports {imported}; sim_player.{here} knows only rooms before it, {WORLD}")
        room, target = room_of(module), room_of(imported)
        if room and target and target not in ROOMS[room]:
            found.append(f"{module} imports {imported}; {room} may use {sorted(ROOMS[room])}")
    return found


@pytest.mark.slow
def test_each_module_keeps_the_laws() -> None:
    """Imports run down, no forbidden word, retired name or open door, no algorithm in a verb; every breach is named."""
    found = []
    for path in SOURCES:
        module, source = module_name(path), source_of(path)
        found += violations(module, imported_modules(source))
        broken = forbidden_words(module, source) + open_doors(module, source)
        broken += retired_names(nodes_of(source)) + ["a retired word"] * retired(path.stem)
        broken += algorithms(source) if is_verb(module) else []
        broken += early_plug_ins(source) if module.startswith("mirrorwave.commands.") else []
        found += [f"{module}: {breach}" for breach in broken]
    assert found == []


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("msgs.bus.codec", "import models.physics.mirror"),
        ("models.physics.mirror", "from msgs.bus.zmq import ZmqBus"),
        ("sim_player.player", "from msgs import codec"),
        ("models.perception.find.peaks", "from lab.training import losses"),
        ("models.physics.mirror", "from models.perception import walls"),
        ("nodes.geometry", "def late():\n    import torch"),
        ("nodes.geometry", "import mirrorwave.cli"),
        ("nodes.player", "def late():\n    import contrib.boards.phaser_device"),
        ("mirrorwave.offline", "from lab.measures import frame_scores"),
        ("lab.training.ranks", "import contrib.annotate.manifest"),
        ("sim_player.scene.world", "from sim_player.trace import routes"),
    ],
)
def test_the_law_catches_a_breach(module: str, source: str) -> None:
    assert violations(module, imported_modules(source))


def import_graph(sources: dict[str, str]) -> dict[str, set[str]]:
    """Which modules of `sources` each one imports: at its top, late in a function, or for its types alone."""
    graph: dict[str, set[str]] = {module: set() for module in sources}
    for module, source in sources.items():
        for name in imported_modules(source):
            # a name that is no module itself comes out of its module
            target = name if name in sources else name.rpartition(".")[0]
            if target in sources and target != module:
                graph[module].add(target)
    return graph


def import_circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Groups of modules that all reach each other by imports, each group sorted."""
    reached = {module: _reached_from(module, graph) for module in graph}
    groups = {frozenset(other for other in found if module in reached[other]) for module, found in reached.items()}
    return sorted(sorted(group) for group in groups if group)


def _reached_from(module: str, graph: dict[str, set[str]]) -> set[str]:
    """Modules that imports lead to from a module, itself only by way of a circle."""
    found: set[str] = set()
    waiting = set(graph[module])
    while waiting:
        found.add(name := waiting.pop())
        waiting |= graph[name] - found
    return found


def test_no_modules_import_each_other() -> None:
    """A module is read and tested with all that it imports; in a circle that is every one of its modules."""
    assert import_circles(import_graph({module_name(path): source_of(path) for path in SOURCES})) == []


@pytest.mark.parametrize(
    ("sources", "circle"),
    [
        ({"a": "import b", "b": "from a import name"}, ["a", "b"]),
        ({"a": "import b", "b": "def late():\n    import a"}, ["a", "b"]),
        ({"a": "from r import b", "r.b": "if TYPE_CHECKING:\n    from a import Name"}, ["a", "r.b"]),
        ({"a": "import b", "b": "import c", "c": "import a", "d": "import a"}, ["a", "b", "c"]),
    ],
)
def test_the_law_of_circles_catches_a_breach(sources: dict[str, str], circle: list[str]) -> None:
    assert import_circles(import_graph(sources)) == [circle]


def test_the_law_of_circles_lets_pass_what_runs_one_way() -> None:
    sources = {"a": "import b, c", "b": "import c\nfrom c import b", "c": "import numpy", "r": "from r import a"}
    assert import_circles(import_graph(sources)) == []


def test_supervisor_imports_no_process_of_the_graph() -> None:
    """A launch file names modules; the supervisor must not pull numba, onnxruntime or a scene into its own process."""
    heavy = {"nodes.ra_former", "nodes.player", "nodes.geometry", "nodes.dense_predictor"}
    imports = imported_modules((ROOT / "nodes" / "process" / "supervisor.py").read_text())
    assert not {name for name in imports for node in heavy if name.startswith(node)}


def test_no_room_is_a_warehouse() -> None:
    files = Counter(module_name(path.parent) for path in SOURCES if path.name != "__init__.py")
    assert {folder: count for folder, count in files.items() if count > MAX_FILES} == {}


#: What a verb needs no import of: it hands options to one call, which computes or draws, and prints the answer.
COMPUTING = ("numpy", "scipy", "matplotlib", "onnxruntime", "torch", "mirrorwave.plots.style")
#: Lines of a module of verbs, lines of a function's body, products and quotients in one.
MAX_VERB_LINES, MAX_VERB_BODY, MAX_VERB_PRODUCTS = 280, 55, 4


def algorithms(source: str) -> list[str]:
    """Signs that a module of verbs computes itself."""
    tree = parsed(source)
    found = [
        f"imports {name}" for name in _run_time_imports(tree) if f"{name}.".startswith(tuple(map(_dotted, COMPUTING)))
    ]
    lines = len(source.splitlines())
    found += [f"{lines} lines"] if lines > MAX_VERB_LINES else []
    for function in (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)):
        body = (function.end_lineno or 0) - function.body[0].lineno + 1
        found += [f"{function.name}: a body of {body} lines"] if body > MAX_VERB_BODY else []
        operators = [node.op for node in ast.walk(function) if isinstance(node, ast.BinOp)]
        products = sum(isinstance(one, ast.Mult | ast.Div | ast.Pow | ast.MatMult) for one in operators)
        found += [f"{function.name}: {products} products"] if products > MAX_VERB_PRODUCTS else []
    return found


def _dotted(name: str) -> str:
    return f"{name}."


def _run_time_imports(tree: ast.Module) -> list[str]:
    """Every import that is made when the program runs, lazy ones included, those for type checkers not."""
    typing_only = {
        id(inner)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        for inner in ast.walk(node)
    }
    left = [
        node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom) and id(node) not in typing_only
    ]
    return [name for node in left for name in imported_modules(ast.unparse(node))]


@pytest.mark.parametrize(
    "source",
    [
        "import numpy as np",
        "def late():\n    from scipy import signal",
        "def draw():\n    from mirrorwave.plots.style import new_figure",
        "x = 1\n" * (MAX_VERB_LINES + 1),
        "def verb():\n" + "    x = 1\n" * (MAX_VERB_BODY + 1),
        "def level(a):\n    return a * a * a * a * a * a",
    ],
)
def test_the_law_of_verbs_catches_a_breach(source: str) -> None:
    assert algorithms(source)


def test_the_law_of_verbs_lets_types_pass() -> None:
    assert algorithms("if TYPE_CHECKING:\n    import numpy as np") == []


def is_verb(module: str) -> bool:
    """Whether a module holds verbs: of the command line, of the laboratory, of a plug-in."""
    return module.startswith(("mirrorwave.commands.", "lab.commands.")) or module.endswith("verb")


def test_a_verb_imports_the_laboratory_late() -> None:
    assert early_plug_ins("from lab.training import ranks") == ["imports lab.training.ranks at once"]
    assert early_plug_ins("def verb():\n    import contrib.boards") == []


def forbidden_words(module: str, source: str) -> list[str]:
    """Calls of eval and exec, below the command line of exit and print too: `line: word`."""
    forbidden = {"eval", "exec"} | (
        set() if module.startswith(("mirrorwave.", "lab.", "contrib.")) else {"exit", "print"}
    )
    return [
        f"{node.lineno}: {node.func.id}"
        for node in nodes_of(source)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in forbidden
    ]


def test_the_law_of_words_catches_a_breach() -> None:
    assert forbidden_words("nodes.node", "def late():\n    print(1)") == ["2: print"]
    assert forbidden_words("mirrorwave.cli", "print(1)\neval('1')") == ["2: eval"]


#: Calls and modules that let data run code, a shell read arguments, or somebody else take a file's name first.
FORBIDDEN_CALLS = {
    *("yaml.unsafe_load", "yaml.unsafe_load_all", "yaml.full_load", "yaml.full_load_all"),
    *("os.system", "os.popen", "subprocess.getoutput", "subprocess.getstatusoutput"),
    *("tempfile.mktemp", "ssl._create_unverified_context"),
}
FORBIDDEN_MODULES = {"pickle", "marshal", "shelve", "dill", "cloudpickle", "joblib", "jsonpickle"}
#: Modules that may wait for other machines: one asks for keys, the other takes numbers from the address of one sensor.
NETWORK_MODULES = ("contrib.two_machines.exporter", "contrib.boards.dca1000_socket")
LOOPBACK = ("127.0.0.1", "::1", "localhost")


def open_doors(module: str, source: str) -> list[str]:
    """Breaches of the laws of security in a source: `line: what`."""
    tree = parsed(source)
    nodes = nodes_of(source)
    names = _imported_names(nodes)
    constants = {
        target.id: node.value.value
        for node in tree.body
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Constant)
        for target in node.targets
        if isinstance(target, ast.Name)
    }
    safe = {"SafeLoader", "CSafeLoader", "BoundedLoader", "StrictLoader"}
    safe |= {
        node.name
        for node in nodes
        if isinstance(node, ast.ClassDef) and safe & {ast.unparse(base).rpartition(".")[2] for base in node.bases}
    }
    found = [f"imports {name}" for name in names.values() if name.split(".")[0] in FORBIDDEN_MODULES]
    for call in (node for node in nodes if isinstance(node, ast.Call)):
        reason = _reason_against(call, _full_name(call.func, names), safe)
        if not reason and module not in NETWORK_MODULES and _reaches_out(call, constants):
            reason = "waits for other machines"
        found += [f"{call.lineno}: {reason}"] if reason else []
    return found


def _imported_names(nodes: Iterable[ast.AST]) -> dict[str, str]:
    """What each imported name of a source stands for."""
    names: dict[str, str] = {}
    for node in nodes:
        if isinstance(node, ast.Import):
            names |= {alias.asname or alias.name: alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}
    return names


def _full_name(func: ast.expr, names: dict[str, str]) -> str:
    if isinstance(func, ast.Attribute):
        return f"{_full_name(func.value, names)}.{func.attr}"
    return names.get(func.id, func.id) if isinstance(func, ast.Name) else "?"


def _reason_against(call: ast.Call, name: str, safe_loaders: set[str]) -> str:
    """Why a call is forbidden, empty if it is not."""
    given = {keyword.arg: keyword.value for keyword in call.keywords}
    said = {key: value.value for key, value in given.items() if isinstance(value, ast.Constant)}
    if name in FORBIDDEN_CALLS:
        return name
    if name in ("yaml.load", "yaml.load_all"):
        loader = given.get("Loader") or (call.args[1] if len(call.args) > 1 else None)
        loader_name = ast.unparse(loader).rpartition(".")[2] if loader is not None else ""
        return "" if loader_name in safe_loaders else f"{name} without a safe loader"
    if name == "torch.load" and said.get("weights_only") is not True:
        return "torch.load without weights_only=True"
    if "allow_pickle" in given and said.get("allow_pickle") is not False:
        return "allow_pickle"
    if "shell" in given and said.get("shell") is not False:
        return "a shell"
    # of a capture it means its checksum
    if said.get("verify") is False and not name.endswith("SigmfCapture.open"):
        return "verify=False"
    return ""


def _reaches_out(call: ast.Call, constants: dict[str, object]) -> bool:
    """Whether a call binds a socket, or makes a server, that other machines can reach."""
    action = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
    hosts = [keyword.value for keyword in call.keywords if keyword.arg == "host"]
    if action in ("bind", "create_server", "start_server") and call.args:
        hosts.append(call.args[0])
    return not all(_stays(host, constants) for host in hosts)


def _stays(address: ast.expr, constants: dict[str, object]) -> bool:
    """Whether an address is a path or surely of this machine."""
    if isinstance(address, ast.Tuple) and address.elts:
        return _stays(address.elts[0], constants)
    if isinstance(address, ast.JoinedStr) and isinstance(address.values[0], ast.Constant):
        return str(address.values[0].value).startswith("ipc://")
    value = constants.get(address.id) if isinstance(address, ast.Name) else getattr(address, "value", None)
    return isinstance(value, str) and (value in LOOPBACK or value.startswith(("ipc://", "inproc://")))


@pytest.mark.parametrize(
    "source",
    [
        "import yaml\nyaml.load(text)",
        "import yaml\nyaml.load(text, Loader=yaml.Loader)",
        "import yaml\nyaml.load(text, yaml.FullLoader)",
        "from yaml import unsafe_load as read\nread(text)",
        "import numpy as np\nnp.load(path, allow_pickle=True)",
        "import numpy as np\nnp.load(path, allow_pickle=wanted)",
        "import torch\ntorch.load(path)",
        "import torch as t\nt.load(path, weights_only=False)",
        "import subprocess\nsubprocess.run(command, shell=True)",
        "from os import system\nsystem(command)",
        "import os\nos.popen(command)",
        "from tempfile import mktemp\nmktemp()",
        "import marshal",
        "def late():\n    from shelve import open",
        "import dill.source",
        "import requests\nrequests.get(url, verify=False)",
        "listener.bind(('', 80))",
        "listener.bind(('0.0.0.0', 80))",
        "HOST = '0.0.0.0'\nlistener.bind((HOST, 80))",
        "listener.bind((chosen, 80))",
        "publisher.bind('tcp://*:7000')",
        "publisher.bind(f'tcp://{host}:7000')",
        "publisher.bind(address)",
        "import socket\nsocket.create_server(('::', 80))",
        "import uvicorn\nuvicorn.run(app, host='0.0.0.0')",
    ],
)
def test_the_law_of_doors_catches_a_breach(source: str) -> None:
    assert open_doors("nodes.node", source)


@pytest.mark.parametrize(
    "source",
    [
        "import yaml\nyaml.load(text, Loader=yaml.SafeLoader)",
        "import yaml\nclass Strict(yaml.SafeLoader): ...\nyaml.load(text, Strict)",
        "import numpy as np\nnp.load(path, allow_pickle=False)",
        "import torch\ntorch.load(path, weights_only=True)",
        "import subprocess\nsubprocess.run([command], shell=False)",
        "HOST = '127.0.0.1'\nlistener.bind((HOST, 0))",
        "publisher.bind(f'ipc://{path}')",
    ],
)
def test_the_law_of_doors_lets_pass_what_is_shut(source: str) -> None:
    assert open_doors("nodes.node", source) == []


def test_only_the_link_and_a_sensor_on_ethernet_may_bind_what_they_are_told() -> None:
    source = "publisher.bind(address)"
    assert [open_doors(module, source) for module in NETWORK_MODULES] == [[], []]
    assert open_doors("msgs.bus.zmq", source)


def test_launch_is_data() -> None:
    """`launch/` holds YAML: ROS 2 owns the import name."""
    assert not list((ROOT / "launch").rglob("*.py"))


def test_topics_name_each_message_once() -> None:
    from msgs.bus.topics import TOPICS

    assert len({topic.type for topic in TOPICS.values()}) == len(TOPICS)
    for topic in TOPICS.values():
        assert topic.history_bytes >= topic.max_bytes >= 1024, topic.name


def test_kernels_are_compiled_by_one_decorator() -> None:
    """Only the solver, which runs in parallel, and the doctor, which tries the compiler, use numba's own."""
    known = ("models.compiled", "lab.full_wave.", "mirrorwave.diagnose.doctor_machine")
    names = [module_name(path) for path in SOURCES if "njit" in source_of(path)]
    assert "models.compiled" in names
    assert [name for name in names if not name.startswith(known)] == []


def test_no_test_has_the_home_of_its_user() -> None:
    """All that programs keep of a user lies in the run's own home: here, and in what a test starts."""
    from lab.tradeoff.latency_budget import cache_path
    from msgs.bus.zmq import run_dir

    home, users = Path(os.environ[VARIABLE]), Path(pwd.getpwuid(os.getuid()).pw_dir)
    assert home.resolve() != users.resolve()
    assert {name: Path(os.environ[name]) for name in FOLDERS} == {name: home / path for name, path in FOLDERS.items()}
    assert all(path.is_relative_to(home) for path in (Path.home(), cache_path(), run_dir("default")))
    started = subprocess.run(
        [sys.executable, "-c", "import pathlib; print(pathlib.Path.home())"], capture_output=True, text=True, check=True
    )
    assert Path(started.stdout.strip()) == home


def test_nothing_finds_a_home_but_by_the_environment() -> None:
    """Neither by the user's number nor, in a process without variables, by its lack of a HOME."""
    assert [module_name(path) for path in SOURCES if "pwd" in imported_modules(source_of(path))] == []
    tests = {path: path.read_text() for path in (ROOT / "tests").rglob("*.py")}
    assert [str(path) for path, source in tests.items() if "env={" in source and bare_environments(source)] == []
    assert bare_environments("subprocess.run(words, env={'PATH': path})") == [1]
    assert bare_environments("subprocess.run(words, env={**os.environ, 'PATH': path})") == []


def bare_environments(source: str) -> list[int]:
    """Lines of calls that start a process with variables of their own alone."""
    return [
        node.lineno
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Attribute)
        and node.func.attr in ("run", "Popen", "check_output", "check_call", "call")
        and any(
            keyword.arg == "env" and isinstance(keyword.value, ast.Dict) and None not in keyword.value.keys
            for keyword in node.keywords
        )
    ]
