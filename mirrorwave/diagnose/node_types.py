"""Modules that a launch file can name: the shipped nodes, and those that installed packages bring."""

from __future__ import annotations

import inspect
from types import ModuleType
from typing import Any

import msgspec

from mirrorwave.diagnose.findings import Finding, Status
from mirrorwave.reference import fields_of, node_modules
from msgs.bus.topics import TOPICS
from msgs.files.plugins import EFFECTS, NODES, Plugin, plugins
from nodes.node import Node, node_module

_SHIPPED = "mirrorwave"


def node_types() -> list[dict[str, Any]]:
    """Return one row for each node: module (the word for a launch file), package, topics, parameters, and its error."""
    return [_row(module, _SHIPPED) for module in node_modules()] + plugged_types()


def plugged_types() -> list[dict[str, Any]]:
    """Return the rows of the nodes that installed packages bring, broken ones included."""
    brought = plugins(NODES)
    rows = [_row(plugin.name, plugin.package) for plugin in brought.usable.values()]
    return rows + [
        _blank(refusal.plugin.name, refusal.plugin.package) | {"error": refusal.reason} for refusal in brought.refused
    ]


def named_types(name: str) -> list[dict[str, Any]]:
    """Return the row of one module, by the word for a launch file; `ValueError` for one that is no node."""
    known = [row for row in plugged_types() if row["module"] == name]
    if not known:
        # also a module that no package declares, as long as it can be imported
        node_module(name, name)
    return known or [_row(name, _SHIPPED if name in node_modules() else "no package")]


def node_classes(module: ModuleType) -> list[Any]:
    """Return the classes of nodes that a module defines."""
    kinds = [kind for _, kind in inspect.getmembers(module, inspect.isclass) if kind.__module__ == module.__name__]
    return [kind for kind in kinds if issubclass(kind, Node)]


def plugin_findings() -> list[Finding]:
    """Return whether each node, effect and topic of others can be used, for the doctor; none if there is none."""
    findings = [_finding("node", Plugin(row["module"], "", row["package"]), row["error"]) for row in plugged_types()]
    effects = plugins(EFFECTS)
    findings += [_finding("effect", refusal.plugin, str(refusal)) for refusal in effects.refused]
    findings += [Finding(f"topic {name} of {TOPICS.origin(name)}", Status.OK, "can be used") for name in TOPICS.own()]
    findings += [Finding(f"topic {name}", Status.FAILED, line) for name, line in TOPICS.refused.items()]
    return findings + [_effect_finding(plugin) for plugin in effects.usable.values()]


def _effect_finding(plugin: Plugin) -> Finding:
    from sim_player.effects.table import effect_of

    try:
        effect_of(plugin)
    except ValueError as error:
        return _finding("effect", plugin, str(error))
    return _finding("effect", plugin, "")


def _finding(kind: str, plugin: Plugin, error: str) -> Finding:
    detail = error.removeprefix(f"{plugin}: ")
    return Finding(f"{kind} {plugin}", Status.FAILED if error else Status.OK, detail or "can be used")


def _row(name: str, package: str) -> dict[str, Any]:
    try:
        module = node_module(name, name)
    except ValueError as error:
        reason = str(error).removeprefix(f"{name}.module: ").removeprefix(f"{name} of {package}: ")
        return _blank(name, package) | {"error": reason}
    return _blank(name, package) | {
        "about": (inspect.getdoc(module) or "").partition("\n")[0],
        "inputs": _topics(module, "inputs"),
        "outputs": _topics(module, "outputs"),
        "params": _params(module.Params, ""),
    }


def _params(kind: type, prefix: str) -> list[dict[str, str]]:
    """Return the parameters of a type as `-p NODE.KEY=VALUE` takes them: those of structures by dotted keys."""
    rows = []
    for field, words in zip(msgspec.structs.fields(kind), fields_of(kind), strict=True):
        if isinstance(field.default, msgspec.Struct):
            rows += _params(type(field.default), f"{prefix}{words.name}.")
            continue
        annotation, about = (text.replace("\\|", "|") for text in (words.annotation, words.comment))
        default = words.default.replace("\\|", "|").strip("`")
        rows.append({"name": f"{prefix}{words.name}", "type": annotation, "default": default, "about": about})
    return rows


def _blank(name: str, package: str) -> dict[str, Any]:
    return {"module": name, "package": package, "about": "", "inputs": [], "outputs": [], "params": [], "error": ""}


def _topics(module: ModuleType, side: str) -> list[str]:
    return list(dict.fromkeys(topic for kind in node_classes(module) for topic in getattr(kind, side)))
