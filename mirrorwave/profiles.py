"""Named profiles: node parameters laid over a launch file's own."""

from __future__ import annotations

from typing import Any

from msgspec.structs import replace

from msgs.files.shipped import LAUNCH
from msgs.values.wording import did_you_mean
from nodes.process.launch_file import LaunchFile, read_yaml_mapping, with_params
from nodes.process.validation import merged

PROFILES = LAUNCH / "profiles"
#: The one that runs where none is named.
DEFAULT = "default"


def profile_names() -> list[str]:
    """All profiles, the default first, the others by name."""
    names = sorted(path.stem for path in PROFILES.glob("*.yaml"))
    return sorted(names, key=lambda name: name != DEFAULT)


def read_profile(name: str) -> dict[str, dict[str, Any]]:
    """Node parameters of a profile; raises `ValueError` with the names there are."""
    path = PROFILES / f"{name}.yaml"
    if name not in profile_names():
        known = profile_names()
        raise ValueError(
            f"--profile: unknown profile {name!r}; known are {', '.join(known)}{did_you_mean(name, known)}"
        )
    return read_yaml_mapping(path)


def with_profile(launch: LaunchFile, name: str) -> LaunchFile:
    """`launch` with a profile's parameters; raises `ValueError` where it lacks one of the nodes."""
    return with_params(launch, read_profile(name), str(PROFILES / f"{name}.yaml"))


def over_default(launch: LaunchFile) -> LaunchFile:
    """`launch` laid over the default profile: what the file says itself holds, and it need not have every node."""
    profile = read_profile(DEFAULT)
    nodes = {
        name: replace(entry, params=merged(profile.get(entry.module.removeprefix("nodes."), {}), entry.params))
        for name, entry in launch.nodes.items()
    }
    return replace(launch, nodes=nodes)
