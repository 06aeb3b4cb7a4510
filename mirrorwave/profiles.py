"""Named profiles: node parameters laid over a launch file's own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from nodes.launch_file import LaunchFile, read_yaml_mapping, with_params

LAUNCH_DIR = Path(__file__).resolve().parents[1] / "launch"
PROFILES = LAUNCH_DIR / "profiles"
#: The one that says nothing: parameters as the modules give them.
DEFAULT = "default"


def profile_names() -> list[str]:
    """All profiles, the default first, the others by name."""
    names = sorted(path.stem for path in PROFILES.glob("*.yaml"))
    return sorted(names, key=lambda name: name != DEFAULT)


def read_profile(name: str) -> dict[str, dict[str, Any]]:
    """Node parameters of a profile; raises `ValueError` with the names there are."""
    path = PROFILES / f"{name}.yaml"
    if name not in profile_names():
        raise ValueError(f"--profile: unknown profile {name!r}; known are {', '.join(profile_names())}")
    return read_yaml_mapping(path)


def with_profile(launch: LaunchFile, name: str) -> LaunchFile:
    """`launch` with a profile's parameters; raises `ValueError` where it lacks one of the nodes."""
    return with_params(launch, read_profile(name), str(PROFILES / f"{name}.yaml"))
