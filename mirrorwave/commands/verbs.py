"""Verbs by name: modules of verbs that the command line takes from beside the floors and from other packages."""

from __future__ import annotations

import importlib
import importlib.util
from typing import Any

import typer

from msgs.files.plugins import VERBS, plugins


def loaded(target: str) -> Any:
    """What `module:attribute` names; None where the module is not there."""
    module_name, _, attribute = target.partition(":")
    if importlib.util.find_spec(module_name) is None:
        return None
    return getattr(importlib.import_module(module_name), attribute)


def plugged_in(verb: str = "") -> dict[str, typer.Typer]:
    """Verb groups of other installed packages by name, or the one that is asked for.

    Each is the `app` (`typer.Typer`) of a module that an entry point of the group `mirrorwave.verbs` names. One that is
    broken is left out, but for the one that is asked for: `ValueError` says what it lacks.
    """
    brought = plugins(VERBS)
    groups = {}
    for name in [verb] if verb else brought.usable:
        try:
            if (plugin := brought.plugin(name)) is not None:
                groups[name] = plugin.load("app").app
        except ValueError:
            if verb:
                raise
    return groups
