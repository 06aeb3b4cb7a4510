"""Bits of the path effects: a path carries the bit of every effect without which it would not exist."""

from __future__ import annotations

from msgs.files.plugins import EFFECTS, plugins

#: Path effects in the order in which they act, which is that of their bits.
PATH_EFFECTS = (
    "los_objects",
    "los_surfaces",
    "specular_relay",
    "diffuse_scattering",
    "curved_wall",
    "second_relay",
    "non_cofocal",
    "wall_transmission",
    "edge_diffraction",
    "ground_bounce",
    "object_interreflection",
    "mirrored_diffraction",
)
#: Bits of `Paths.needs`.
MAX_PATH_EFFECTS = 32
#: Effects that installed packages bring, in order of name; each has a bit, whether it makes paths or not.
PLUGGED_IN = tuple(name for name in plugins(EFFECTS).usable if name not in PATH_EFFECTS)[
    : MAX_PATH_EFFECTS - len(PATH_EFFECTS)
]
_BIT = {name: 1 << index for index, name in enumerate((*PATH_EFFECTS, *PLUGGED_IN))}


def bit(name: str) -> int:
    """Return the bit of a path effect in `Paths.needs`; `ValueError` for a name that is none."""
    if name not in _BIT:
        raise ValueError(f"{name!r} is no path effect of mirrorwave, nor an effect of an installed package")
    return _BIT[name]


def bits(names: frozenset[str]) -> int:
    """Return the bits of all path effects among some names."""
    return sum(value for name, value in _BIT.items() if name in names)
