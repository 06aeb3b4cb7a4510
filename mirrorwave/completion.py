"""Shell completion (Tab): topics, nodes of a running graph, profiles, launch files, scenes, materials.

Each function gets the word so far and gives what begins with it, from file names and tables alone: no bus is opened.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import typer

from msgs.files.shipped import CHECKOUT


def complete_topics(incomplete: str) -> list[str]:
    """Names of topics, without those of sensors with a name."""
    from msgs.bus.topics import TOPICS, sensor_of

    return beginning((topic for topic in TOPICS if not sensor_of(topic)), incomplete)


def complete_nodes(ctx: typer.Context, incomplete: str) -> list[str]:
    """Nodes whose sockets stand in the run directory of the domain that was named so far."""
    from mirrorwave.console import DEFAULT_DOMAIN
    from msgs.bus.zmq import run_dir

    domain = ctx.params.get("domain") or os.environ.get("MIRRORWAVE_DOMAIN", DEFAULT_DOMAIN)
    try:
        entries = sorted(run_dir(domain).iterdir())
    except (OSError, ValueError):
        return []
    return beginning((entry.name.partition("@")[2] for entry in entries if "@" in entry.name), incomplete)


def complete_profiles(incomplete: str) -> list[str]:
    """Names of profiles, and YAML files and folders where the word leads."""
    from mirrorwave.profiles import profile_names

    return [*beginning(profile_names(), incomplete), *_files(incomplete, "launch/profiles")]


def complete_launch_files(incomplete: str) -> list[str]:
    """Launch files of the checkout, as named from here, and YAML files and folders where the word leads."""
    return _files(incomplete, "launch")


def complete_scenes(incomplete: str) -> list[str]:
    """The same for scenes."""
    return _files(incomplete, "launch/scenes")


def complete_materials(incomplete: str) -> list[str]:
    """Materials of the table."""
    from models.physics.materials import wall_names

    return beginning(wall_names(), incomplete)


def beginning(names: Iterable[str], incomplete: str) -> list[str]:
    """The names that begin with a word, each once."""
    return [name for name in dict.fromkeys(names) if name.startswith(incomplete)]


def _files(incomplete: str, folder: str) -> list[str]:
    here = Path(incomplete or ".")
    parent = here if incomplete.endswith("/") or not incomplete else here.parent
    shipped = (
        [f"{folder}/{path.name}" for path in sorted((CHECKOUT / folder).glob("*.yaml"))]
        if Path(folder).is_dir()
        else []
    )
    try:
        near = [
            f"{path}/" if path.is_dir() else str(path)
            for path in sorted(parent.iterdir())
            if not path.name.startswith(".") and (path.is_dir() or path.suffix in (".yaml", ".yml"))
        ]
    except OSError:
        near = []
    return beginning([*shipped, *near], incomplete)


#: Parameters of a graph, and single ones over them.
Profile = Annotated[
    str,
    typer.Option(
        metavar="NAME|FILE", help="Parameters: default, accurate, ..., or a file.", autocompletion=complete_profiles
    ),
]
Overrides = Annotated[
    list[str] | None, typer.Option("--param", "-p", metavar="NODE.KEY=VALUE", help="Override; may be repeated.")
]
#: A node of a running graph.
NodeName = Annotated[
    str, typer.Argument(metavar="NODE", help="Node, as `node list` names it.", autocompletion=complete_nodes)
]
