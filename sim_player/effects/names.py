"""Bits of the path effects: a path carries the bit of every effect without which it would not exist."""

from __future__ import annotations

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
)
_BIT = {name: 1 << index for index, name in enumerate(PATH_EFFECTS)}


def bit(name: str) -> int:
    """Return the bit of a path effect in `Paths.needs`."""
    return _BIT[name]


def bits(names: frozenset[str]) -> int:
    """Return the bits of all path effects among some names."""
    return sum(value for name, value in _BIT.items() if name in names)
