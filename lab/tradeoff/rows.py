"""The rows of the accuracy-versus-time report: node parameters, each set laid over a profile."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from mirrorwave.profiles import checked_profile, profile_names, profile_path
from msgs.files.shipped import LAUNCH
from nodes.process.launch_file import read_yaml_mapping
from nodes.process.validation import convert_at, merged

#: What `mirrorwave tradeoff` compares unless told otherwise.
DEFAULT_SETTINGS = LAUNCH / "tradeoff.yaml"
#: Nodes whose parameters a row may set.
STAGES = ("ra_former", "dense_predictor", "geometry")
#: Profile that rows are laid over and compared with unless they name another.
BASE = "default"
#: Switch of the rows that are named profiles.
PROFILE = "profile"


class Setting(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One row: a switch, what it is set to, and the parameters of each node that say so."""

    switch: str
    value: str
    params: dict[str, dict[str, Any]] = {}
    #: Profile that they are laid over, and that the row is compared with.
    over: str = BASE

    def __post_init__(self) -> None:
        unknown = self.params.keys() - set(STAGES)
        if unknown:
            raise ValueError(f"params must be of {', '.join(STAGES)}, got {', '.join(sorted(unknown))}")

    @property
    def name(self) -> str:
        """Name of the row: switch and value, or the profile's own name."""
        return self.value if self.switch == PROFILE else f"{self.switch}: {self.value}"

    def of(self, stage: str) -> dict[str, Any]:
        """Parameters of one node."""
        return self.params.get(stage, {})


class _SettingsFile(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    rows: list[Setting]


def read_settings(path: Path = DEFAULT_SETTINGS, profile_files: Sequence[str] = ()) -> list[Setting]:
    """All rows: the profiles, the default first, then those of a file.

    `profile_files`: further profiles. Raises `ValueError` naming the file and the row where two rows share a name, one
    sets what no node has, or is laid over no profile.
    """
    bases = {row.value: row for row in (*profiles(), *map(profile_setting, profile_files))}
    own = convert_at(read_yaml_mapping(path), _SettingsFile, f"{path}: ").rows
    names = [row.name for row in (*bases.values(), *own)]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"{path}: rows must differ in name, got {name!r} twice")
    for row in own:
        if row.over not in bases:
            raise ValueError(f"{path}: {row.name}: over must be one of {', '.join(bases)}, got {row.over!r}")
    laid_over = [msgspec.structs.replace(row, params=merged(bases[row.over].params, row.params)) for row in own]
    return [*bases.values(), *laid_over]


def profiles() -> list[Setting]:
    """The named profiles, the default first, the others by name."""
    return [profile_setting(name) for name in profile_names()]


def profile_setting(name: str) -> Setting:
    """Return a profile by its name or file; `ValueError` names what is wrong."""
    row = {"switch": PROFILE, "value": name, "params": checked_profile(name)}
    return convert_at(row, Setting, str(profile_path(name)))
