"""Launch files: a graph as YAML, read into frozen values; every error names the file, the field and the rule."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from enum import StrEnum
from pathlib import Path
from typing import Any

import msgspec
import yaml

from msgs.bus.topics import TOPICS, Declaration, require_facts, require_topic_name
from msgs.files.former_modules import present_name
from msgs.files.plugins import MODULE_NAME
from msgs.files.shipped import shipped_path
from msgs.files.yaml_loader import PlainDumper, StrictLoader, in_words
from msgs.values.arrays import require_sensor_name
from msgs.values.wording import as_utf8, did_you_mean
from nodes.node import NODE_NAME
from nodes.process.validation import convert_at, merged

#: Characters without a meaning of their own that YAML takes, for bytes of a path, which it does not.
_STAND_IN = {0xDC00 + byte: 0xF700 + byte for byte in range(128, 256)}
_BYTES = {stand_in: byte for byte, stand_in in _STAND_IN.items()}
#: Larger files are no launch files.
MAX_BYTES = 1 << 20
#: The supervisor's own name on the bus.
SUPERVISOR = "supervisor"
RECORDER = "recorder"
RECORDER_MODULE = "nodes.recorder"
VIEWER_MODULE = "nodes.bev_viewer"
#: Joins the views of several radars.
FUSION_MODULE = "nodes.view_fusion"
#: Hosts a group of nodes; its parameters are their modules and parameters by name.
GROUP_MODULE = "nodes.process.group"
#: Nodes that keep the token of their address while they are restarted.
_TOKEN_MODULES = (VIEWER_MODULE, "contrib.foxglove.foxglove_bridge")


def _require_duration(name: str, value: float) -> None:
    if not (math.isfinite(value) and value >= 0.0):
        raise ValueError(f"{name} must be finite and not negative, got {value!r}")


class RestartPolicy(StrEnum):
    """Conditions under which an ended node is started again."""

    ON_FAILURE = "on-failure"
    ALWAYS = "always"
    NEVER = "never"


class Restart(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Restart of a node: at once, then after `delay_s`, doubling up to `max_delay_s`; `max_restarts` in `window_s`."""

    policy: RestartPolicy = RestartPolicy.ON_FAILURE
    delay_s: float = 0.2
    max_delay_s: float = 5.0
    max_restarts: int = 5
    window_s: float = 60.0

    def __post_init__(self) -> None:
        for name in ("delay_s", "max_delay_s", "window_s"):
            _require_duration(name, getattr(self, name))
        if self.max_restarts < 0:
            raise ValueError(f"max_restarts must not be negative, got {self.max_restarts!r}")

    def backoff_s(self, recent_restarts: int) -> float:
        """Return the delay before the next start after `recent_restarts` restarts inside the window."""
        if recent_restarts == 0:
            return 0.0
        # the exponent is bounded because 2.0 ** 1024 overflows
        return min(self.max_delay_s, self.delay_s * 2.0 ** min(recent_restarts - 1, 60))


class NodeEntry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One node of the graph, or one process."""

    #: Module that defines Params and create(params): its dotted name, or the name that an installed package gives it
    #: under the entry points `mirrorwave.nodes`.
    module: str
    params: dict[str, Any] = {}
    #: Nodes that must be ready before this one begins. It gets ready beside them, except after a recorder, which
    #: records the others from their first word on.
    after: tuple[str, ...] = ()
    restart: Restart = Restart()
    #: A node that could have sent a heartbeat for longer is killed and restarted: time in which it waits for a core
    #: is not counted. A blocked one (no thread of it runs) is given half of this, a stopped process a fifth.
    hang_timeout_s: float = 5.0
    #: Maximum time from the start of the process to its first READY heartbeat.
    start_timeout_s: float = 60.0
    env: dict[str, str] = {}
    #: The graph is done when this node ends with exit code 0.
    ends_graph: bool = False
    #: Left out by `--headless`.
    viewer: bool = False
    #: Process that it shares with all nodes that name the same, a thread each; empty: one of its own.
    process: str = ""
    #: Name of the sensor that it works for where the graph has several: of the sensor `left` its topic `radar/beam` is
    #: `radar/left/beam`. Empty: it is the only one.
    sensor: str = ""

    def __post_init__(self) -> None:
        msgspec.structs.force_setattr(self, "module", present_name(self.module))
        if not MODULE_NAME.fullmatch(self.module):
            raise ValueError(f"module must be a dotted module name, got {self.module!r}")
        if self.sensor:
            require_sensor_name(self.sensor)
        for name in ("hang_timeout_s", "start_timeout_s"):
            _require_duration(name, getattr(self, name))
            if getattr(self, name) == 0.0:
                raise ValueError(f"{name} must be above zero")


class LaunchFile(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A graph: its name, its nodes by name, and the topics that it has beside those of all graphs."""

    name: str
    nodes: dict[str, NodeEntry]
    topics: dict[str, Declaration] = {}

    def __post_init__(self) -> None:
        if not NODE_NAME.fullmatch(self.name):
            raise ValueError(f"name must be of a-z, 0-9 and _, got {self.name!r}")
        for topic, declaration in self.topics.items():
            require_topic_name(topic, "topics")
            require_facts(declaration, f"topics.{topic}")
        if not self.nodes:
            raise ValueError("nodes must name at least one node")
        for node, entry in self.nodes.items():
            self._check_node(node, entry)
        self._check_sensors()
        processes(self)

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of its sensors where there are several."""
        return tuple(dict.fromkeys(entry.sensor for entry in self.nodes.values() if entry.sensor))

    def _check_sensors(self) -> None:
        """Raise `ValueError` for two sensors of one name: one module would publish its topics twice."""
        first: dict[tuple[str, str], str] = {}
        for node, entry in self.nodes.items():
            other = first.setdefault((entry.module, entry.sensor), node)
            if entry.sensor and other != node:
                raise ValueError(
                    f"nodes.{node}.sensor: must differ from that of {other}, which is {entry.module} too, "
                    f"got {entry.sensor!r}"
                )

    def _check_node(self, node: str, entry: NodeEntry) -> None:
        if not NODE_NAME.fullmatch(node):
            raise ValueError(f"nodes.{node}: a node's name must be of a-z, 0-9 and _")
        if node == SUPERVISOR:
            raise ValueError(f"nodes.{node}: this name belongs to the supervisor")
        for other in entry.after:
            if other not in self.nodes:
                raise ValueError(f"nodes.{node}.after: {_unknown(other, self.nodes)}")
        if entry.process:
            self._check_process(node, entry)

    def _check_process(self, node: str, entry: NodeEntry) -> None:
        rule = f"nodes.{node}.process"
        if not NODE_NAME.fullmatch(entry.process) or entry.process == SUPERVISOR:
            raise ValueError(f"{rule} must be of a-z, 0-9 and _, and not {SUPERVISOR}, got {entry.process!r}")
        if entry.process in self.nodes and self.nodes[entry.process].process != entry.process:
            raise ValueError(f"{rule}: node {entry.process!r} has a process of this name and is not in it")
        if entry.module == RECORDER_MODULE:
            raise ValueError(f"{rule}: a recorder has a process of its own, to record how the others fail")
        for other, partner in self.nodes.items():
            if partner.process == entry.process and (partner.restart, partner.env) != (entry.restart, entry.env):
                raise ValueError(f"{rule}: restart and env must be those of {other}, which shares the process")


def start_order(launch: LaunchFile) -> tuple[str, ...]:
    """Return nodes so that each follows all its `after`, otherwise as written; a cycle is a `ValueError`."""
    return _ordered({name: entry.after for name, entry in launch.nodes.items()})


def processes(launch: LaunchFile) -> dict[str, NodeEntry]:
    """Return the processes of a graph in the order in which they start: those of one node, and groups of nodes.

    A cycle among them is a `ValueError`.
    """
    groups: dict[str, list[str]] = {}
    for name in start_order(launch):
        groups.setdefault(launch.nodes[name].process or name, []).append(name)
    home = {name: process for process, names in groups.items() for name in names}
    entries = {process: _process(process, launch, names, home) for process, names in groups.items()}
    return {process: entries[process] for process in _ordered({name: entry.after for name, entry in entries.items()})}


def _process(process: str, launch: LaunchFile, names: list[str], home: Mapping[str, str]) -> NodeEntry:
    nodes = {name: launch.nodes[name] for name in names}
    first = nodes[names[0]]
    after = dict.fromkeys(home[other] for entry in nodes.values() for other in entry.after)
    after.pop(process, None)
    if not first.process:
        return msgspec.structs.replace(first, after=tuple(after))
    return msgspec.structs.replace(
        first,
        module=GROUP_MODULE,
        params={
            name: {"module": entry.module, "params": entry.params, "sensor": entry.sensor}
            for name, entry in nodes.items()
        },
        after=tuple(after),
        hang_timeout_s=max(entry.hang_timeout_s for entry in nodes.values()),
        # made one after the other
        start_timeout_s=sum(entry.start_timeout_s for entry in nodes.values()),
        ends_graph=any(entry.ends_graph for entry in nodes.values()),
    )


def stop_order(launch: LaunchFile) -> tuple[str, ...]:
    """Return processes so that each precedes all its `after`, otherwise as started: sources first, recorder last."""
    entries = processes(launch)
    followers: dict[str, list[str]] = {name: [] for name in entries}
    for name, entry in entries.items():
        for other in entry.after:
            followers[other].append(name)
    return _ordered(followers)


def _ordered(needed: Mapping[str, Iterable[str]]) -> tuple[str, ...]:
    """Return keys so that each follows all it needs, otherwise in the given order."""
    ordered: dict[str, None] = {}
    while waiting := [name for name in needed if name not in ordered]:
        free = next((name for name in waiting if all(other in ordered for other in needed[name])), None)
        if free is None:
            raise ValueError(f"nodes: after makes a cycle among {_names(waiting)}")
        ordered[free] = None
    return tuple(ordered)


def read_launch_file(path: Path) -> LaunchFile:
    """Return the launch file at `path`, or the shipped one of that name; raises `ValueError` naming file, field and
    rule, `OSError` if unreadable.
    """
    if path.suffix in (".mcap", ".sigmf-meta", ".sigmf-data"):
        raise ValueError(
            f"{path}: is a recording, no launch file; mirrorwave process finds its hidden objects, mirrorwave view "
            "plays it"
        )
    value = read_yaml_mapping(shipped_path(path))
    if "nodes" not in value and {"radar", "surfaces", "objects"} & set(value):
        raise ValueError(
            f"{path}: is a scene, no launch file; to run it live: mirrorwave launch launch/corner.yaml "
            f"-p player.scene={path}; to record it: mirrorwave sim run {path} --out NAME.mcap"
        )
    return launch_from_mapping(value, str(path))


def launch_from_mapping(value: Mapping[str, Any], where: str) -> LaunchFile:
    """Return a launch file from plain data; `where` prefixes every error."""
    fields = dict(value)
    nodes = convert_at(fields.pop("nodes", {}), dict[str, Any], f"{where}: nodes")
    topics = convert_at(fields.pop("topics", {}), dict[str, Any], f"{where}: topics")
    # one by one, because msgspec's path writes the key of a mapping as [...]
    entries = {name: convert_at(entry, NodeEntry, f"{where}: nodes.{name}") for name, entry in nodes.items()}
    declared = {name: convert_at(entry, Declaration, f"{where}: topics.{name}") for name, entry in topics.items()}
    return convert_at({**fields, "nodes": entries, "topics": declared}, LaunchFile, f"{where}: ")


def expect_topics(launch: LaunchFile, where: str) -> None:
    """Make the topics known that a launch file declares; their types are imported once they are needed."""
    for name, declaration in launch.topics.items():
        TOPICS.expect(name, declaration, where)


def read_yaml_mapping(path: Path) -> dict[str, Any]:
    """Return a YAML mapping with unique keys of type str, read safely and only up to `MAX_BYTES`."""
    with path.open("rb") as file:
        data = file.read(MAX_BYTES + 1)
    if len(data) > MAX_BYTES:
        raise ValueError(f"{path}: a launch file holds at most {MAX_BYTES} bytes")
    value = parse_yaml(data, str(path))
    if not isinstance(value, dict):
        raise ValueError(f"{path}: expected a mapping, got {in_words(value)}")
    return value


def parse_yaml(text: str | bytes, where: str) -> Any:
    """Return one YAML document of plain values; duplicate keys, aliases and deep nesting are refused.

    Bytes of a path on the command line that are no UTF-8 stay what they are.
    """
    if isinstance(text, str) and as_utf8(text) != text:
        return _with_bytes(parse_yaml(text.translate(_STAND_IN), where))
    try:
        return yaml.load(text, Loader=StrictLoader)
    except yaml.YAMLError as error:
        raise ValueError(f"{where}: {_yaml_reason(error, text)}") from None
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None


def _with_bytes(value: Any) -> Any:
    """Return a value with the bytes that characters stand in for."""
    if isinstance(value, str):
        return value.translate(_BYTES)
    if isinstance(value, dict):
        return {_with_bytes(key): _with_bytes(item) for key, item in value.items()}
    return [_with_bytes(item) for item in value] if isinstance(value, list) else value


def with_params(launch: LaunchFile, params: Mapping[str, Any], where: str) -> LaunchFile:
    """Return `launch` with the parameters of a params file (node -> params) merged over its own.

    The name of a module, as `geometry`, stands for its nodes of all sensors where no node has this name.
    """
    nodes = dict(launch.nodes)
    for name, changes in params.items():
        module = f"nodes.{name}"
        of_sensors = [node for node, entry in nodes.items() if entry.sensor and entry.module == module]
        meant = [name] if name in nodes else of_sensors
        if not meant:
            raise ValueError(f"{where}: {_unknown(name, nodes)}")
        if not isinstance(changes, dict):
            raise ValueError(f"{where}: {name}: expected a mapping of parameters, got {in_words(changes)}")
        for node in meant:
            nodes[node] = msgspec.structs.replace(nodes[node], params=merged(nodes[node].params, changes))
    return msgspec.structs.replace(launch, nodes=nodes)


def with_overrides(launch: LaunchFile, overrides: Iterable[str]) -> LaunchFile:
    """Return `launch` with overrides `node.key=value` (dotted key in the node's params, YAML value), later ones win."""
    for override in overrides:
        path, equals, text = override.partition("=")
        name, *keys = path.strip().split(".")
        if not equals or not keys or not all([name, *keys]):
            raise ValueError(f"-p {override}: expected node.key=value")
        changes: Any = parse_yaml(text, f"-p {override}")
        for key in reversed(keys):
            changes = {key: changes}
        launch = with_params(launch, {name: changes}, f"-p {override}")
    return launch


def with_process(launch: LaunchFile, group: str) -> LaunchFile:
    """Return `launch` with nodes in one process, `process=node,node`; raises `ValueError` naming the rule."""
    process, equals, names = group.partition("=")
    nodes = dict(launch.nodes)
    for name in names.split(",") if equals else ():
        if name not in nodes:
            raise ValueError(f"--group {group}: {_unknown(name, nodes)}")
        nodes[name] = msgspec.structs.replace(nodes[name], process=process)
    if not (process and equals):
        raise ValueError(f"--group {group}: expected process=node,node")
    return msgspec.structs.replace(launch, nodes=nodes)


def with_recorder(launch: LaunchFile, path: Path, params: Mapping[str, Any] | None = None) -> LaunchFile:
    """Return `launch` with a recorder, `params` beside its path, that is ready before all others start."""
    if RECORDER in launch.nodes:
        raise ValueError(f"nodes.{RECORDER}: the launch file has a recorder already; set its path with -p")
    nodes = {RECORDER: NodeEntry(module=RECORDER_MODULE, params={**(params or {}), "path": str(path)})}
    for name, entry in launch.nodes.items():
        nodes[name] = msgspec.structs.replace(entry, after=(RECORDER, *entry.after))
    return msgspec.structs.replace(launch, nodes=nodes)


def with_origin(launch: LaunchFile, command: str, run_dir: Path) -> LaunchFile:
    """Return `launch` with the parameters that are only known at start.

    Recorders: the graph they record, with these parameters, the command and the run directory. Viewers: the file that
    keeps the token of their page while they are restarted.
    """
    metadata = {"launch": dump_launch(without_metadata(launch)), "command": command}
    nodes = dict(launch.nodes)
    for name, entry in recorders(launch).items():
        own = entry.params.get("metadata") or {}
        # a value that is no mapping is passed unchanged to the recorder, which reports the fault
        params = {"run_dir": str(run_dir), **entry.params}
        params["metadata"] = {**metadata, **own} if isinstance(own, Mapping) else own
        nodes[name] = msgspec.structs.replace(entry, params=params)
    for name, entry in _of_module(launch, *_TOKEN_MODULES).items():
        # the metadata of an earlier run would be of another graph
        params = {**entry.params, "token_file": str(run_dir / f"{name}.token")}
        nodes[name] = msgspec.structs.replace(entry, params=params)
    return msgspec.structs.replace(launch, nodes=nodes)


def without_metadata(launch: LaunchFile) -> LaunchFile:
    """Return `launch` without the parameters set by `with_origin`."""
    nodes = dict(launch.nodes)
    for modules, names in (((RECORDER_MODULE,), ("metadata", "run_dir")), (_TOKEN_MODULES, ("token_file",))):
        for name, entry in _of_module(launch, *modules).items():
            kept = {key: value for key, value in entry.params.items() if key not in names}
            nodes[name] = msgspec.structs.replace(entry, params=kept)
    return msgspec.structs.replace(launch, nodes=nodes)


def recorders(launch: LaunchFile) -> dict[str, NodeEntry]:
    """Return the nodes that record."""
    return _of_module(launch, RECORDER_MODULE)


def _of_module(launch: LaunchFile, *modules: str) -> dict[str, NodeEntry]:
    return {name: entry for name, entry in launch.nodes.items() if entry.module in modules}


def without_viewers(launch: LaunchFile) -> LaunchFile:
    """Return `launch` without the nodes marked `viewer`, also in others' `after`."""
    remaining = {name: entry for name, entry in launch.nodes.items() if not entry.viewer}
    nodes = {
        name: msgspec.structs.replace(entry, after=tuple(other for other in entry.after if other in remaining))
        for name, entry in remaining.items()
    }
    return msgspec.structs.replace(launch, nodes=nodes)


def dump_launch(launch: LaunchFile) -> str:
    """Return the launch file as YAML with all defaults written out; it reads back as an equal value."""
    return yaml.dump(msgspec.to_builtins(launch), Dumper=PlainDumper, sort_keys=False, allow_unicode=True)


def _unknown(name: str, nodes: Iterable[str]) -> str:
    return f"unknown node {name!r}; known are {_names(nodes)}{did_you_mean(name, nodes)}"


def _names(names: Iterable[str]) -> str:
    return ", ".join(names)


def _yaml_reason(error: yaml.YAMLError, text: str | bytes) -> str:
    mark, problem = getattr(error, "problem_mark", None), getattr(error, "problem", None)
    lines = len(text.splitlines()) or 1
    position = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
    if mark and mark.line >= lines:
        # libyaml ends every text with a new line
        position = f"line {lines}: "
    return " ".join(f"{position}{problem or error}".split())
