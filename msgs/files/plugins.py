"""Parts that other installed packages bring: entry points of their distributions, each naming a module.

A package declares them, name = module, under `[project.entry-points."mirrorwave.nodes"]`, `"mirrorwave.effects"`,
`"mirrorwave.topics"` or `"mirrorwave.verbs"`. Nothing of a package is imported before `load`.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import re
import traceback
from types import ModuleType
from typing import NamedTuple

NODES, EFFECTS, TOPICS = "mirrorwave.nodes", "mirrorwave.effects", "mirrorwave.topics"
VERBS = "mirrorwave.verbs"
MODULE_NAME = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*")
PLUGIN_NAME = re.compile(r"[a-z][a-z0-9_]{0,63}")


class Plugin(NamedTuple):
    """One entry point: its name, the module that it names, and the package that brings it."""

    name: str
    module: str
    #: Name and version.
    package: str

    def load(self, *needed: str) -> ModuleType:
        """Import the module; `ValueError` that says why it cannot be, or which of the `needed` names it lacks."""
        try:
            module = import_named(self.module)
        except ValueError as error:
            raise ValueError(f"{self}: {error}") from None
        if missing := [name for name in needed if not hasattr(module, name)]:
            raise ValueError(f"{self}: {self.module} must define {', '.join(missing)}")
        return module

    def __str__(self) -> str:
        return f"{self.name} of {self.package}"


class Refusal(NamedTuple):
    """An entry point that cannot be used, and why."""

    plugin: Plugin
    reason: str

    def __str__(self) -> str:
        return f"{self.plugin}: {self.reason}"


class Plugins(NamedTuple):
    """Entry points of a group: those that can be used, by name, and those that cannot."""

    usable: dict[str, Plugin]
    refused: tuple[Refusal, ...]

    def plugin(self, name: str) -> Plugin | None:
        """Return the plugin of a name, None if no package brings one; `ValueError` for one that is refused."""
        for refusal in self.refused:
            if refusal.plugin.name == name:
                raise ValueError(str(refusal))
        return self.usable.get(name)


def plugins(group: str) -> Plugins:
    """Return the entry points of a group in order of name; names that are none or of several packages are refused."""
    by_name: dict[str, list[Plugin]] = {}
    for point in importlib.metadata.entry_points(group=group):
        package = f"{point.dist.name} {point.dist.version}" if point.dist else "an unknown package"
        by_name.setdefault(point.name, []).append(Plugin(point.name, point.value, package))
    usable, refused = {}, []
    for name, candidates in sorted(by_name.items()):
        reason = _refusal(candidates)
        if reason:
            refused.append(Refusal(candidates[0], reason))
        else:
            usable[name] = candidates[0]
    return Plugins(usable, tuple(refused))


def _refusal(candidates: list[Plugin]) -> str:
    """Return why the entry points of one name cannot be used; empty if they can."""
    first, *more = candidates
    if more:
        return f"{', '.join(plugin.package for plugin in more)} has the same name; uninstall one"
    if not PLUGIN_NAME.fullmatch(first.name):
        return f"a name must be of a-z, 0-9 and _, at most 64 of them, got {first.name!r}"
    if not MODULE_NAME.fullmatch(first.module):
        return f"must name a module, got {first.module!r}"
    return ""


def import_named(module_name: str) -> ModuleType:
    """Import a module by its dotted name; `ValueError` in one line says what stopped it."""
    try:
        return importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        missing = error.name or str(error)
        if f"{module_name}.".startswith(f"{missing}."):
            raise ValueError(f"no module named {missing!r}") from None
        raise ValueError(f"{module_name} needs {missing}, which is not installed") from None
    except MemoryError:
        raise
    except (Exception, SystemExit) as error:  # noqa: BLE001 - other people's code must not take the program with it
        raise ValueError(f"{module_name} cannot be imported: {reason_of(error)}") from None


def reason_of(error: BaseException) -> str:
    """Return an exception with file and line of its origin, on one line."""
    text = " ".join(f"{type(error).__name__}: {error}".split())
    if isinstance(error, SyntaxError):
        # names both itself
        return text
    origin = traceback.extract_tb(error.__traceback__)[-1]
    return f"{text} ({origin.filename}:{origin.lineno})"
