"""Profiles, by name or by file: node parameters laid over a launch file's own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from msgspec.structs import replace

from msgs.files.shipped import LAUNCH
from msgs.files.yaml_loader import in_words
from msgs.values.wording import did_you_mean
from nodes.process.launch_file import LaunchFile, read_yaml_mapping, with_params
from nodes.process.validation import convert_at, merged

PROFILES = LAUNCH / "profiles"
#: The one that runs where none is named.
DEFAULT = "default"
#: Former profiles, each read as the one that replaced it.
FORMER = dict.fromkeys(("balanced", "fast", "unfiltered"), DEFAULT)


def profile_names() -> list[str]:
    """All profiles, the default first, the others by name."""
    names = sorted(path.stem for path in PROFILES.glob("*.yaml"))
    return sorted(names, key=lambda name: name != DEFAULT)


def profile_path(name: str) -> Path:
    """File of a profile, by its name or by its path; raises `ValueError` with the names there are."""
    known, name = profile_names(), FORMER.get(name, name)
    if name in known:
        return PROFILES / f"{name}.yaml"
    path = Path(name)
    if path.suffix not in (".yaml", ".yml") and not path.is_file():
        raise ValueError(
            f"--profile: unknown profile {name!r}; known are {', '.join(known)}, or FILE.yaml"
            f"{did_you_mean(name, known)}"
        )
    return path


def read_profile(name: str) -> dict[str, dict[str, Any]]:
    """Node parameters of a profile by its name or file; `ValueError` names what is wrong."""
    path = profile_path(name)
    profile = read_yaml_mapping(path)
    for node, params in profile.items():
        if not isinstance(params, dict):
            raise ValueError(f"{path}: {node}: expected a mapping of parameters, got {in_words(params)}")
    return profile


def nodes_of_file(name: str) -> list[tuple[str, str]]:
    """Nodes that a profile by file sets, each with the file; none of a named one, which is known to be right."""
    return [] if FORMER.get(name, name) in profile_names() else [(node, name) for node in read_profile(name)]


def checked_profile(name: str) -> dict[str, dict[str, Any]]:
    """As `read_profile`, and `ValueError` names the file and the field that a node does not take."""
    # the nodes come along only where they are needed
    from mirrorwave.node_chain import STAGE_PARAMS

    profile, path = read_profile(name), profile_path(name)
    for node in profile.keys() & STAGE_PARAMS.keys():
        convert_at(profile[node], STAGE_PARAMS[node], f"{path}: {node}")
    return profile


def with_profile(launch: LaunchFile, name: str) -> LaunchFile:
    """`launch` with a profile's parameters; raises `ValueError` where it lacks one of the nodes."""
    return with_params(launch, read_profile(name), str(profile_path(name)))


def over_default(launch: LaunchFile) -> LaunchFile:
    """`launch` laid over the default profile: what the file says itself holds, and it need not have every node."""
    profile = read_profile(DEFAULT)
    nodes = {
        name: replace(entry, params=merged(profile.get(entry.module.removeprefix("nodes."), {}), entry.params))
        for name, entry in launch.nodes.items()
    }
    return replace(launch, nodes=nodes)
