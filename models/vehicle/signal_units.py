"""Units of signals in a DBC, in the spellings of public DBC files, and their values in SI."""

from __future__ import annotations

import math
from enum import StrEnum
from typing import NamedTuple


class Dimension(StrEnum):
    """Dimension of a unit; the value is the dimension's name in messages."""

    SPEED = "speed"
    ANGLE = "angle"
    ANGULAR_RATE = "angular rate"
    ACCELERATION = "acceleration"


class Unit(NamedTuple):
    """A unit: its usual spelling, its dimension, and its size in the SI unit of that dimension."""

    name: str
    dimension: Dimension
    to_si: float


SI_NAMES = {
    Dimension.SPEED: "m/s",
    Dimension.ANGLE: "rad",
    Dimension.ANGULAR_RATE: "rad/s",
    Dimension.ACCELERATION: "m/s^2",
}

_DEGREE = math.pi / 180.0
#: (usual spelling, dimension, size in SI, other spellings); compared in lower case and without spaces.
_UNITS: tuple[tuple[str, Dimension, float, tuple[str, ...]], ...] = (
    ("m/s", Dimension.SPEED, 1.0, ("mps", "m/sec", "meter/s", "meters/s", "meter/sec", "meters/sec")),
    ("km/h", Dimension.SPEED, 1.0 / 3.6, ("kph", "kmh", "kmph", "km/hr", "km/hour", "km/std")),
    ("mph", Dimension.SPEED, 0.44704, ("mi/h", "mi/hr", "mile/h", "miles/h", "miles/hour")),
    ("knot", Dimension.SPEED, 1852.0 / 3600.0, ("knots", "kn", "kt", "kts")),
    ("ft/s", Dimension.SPEED, 0.3048, ("fps", "ft/sec", "feet/s")),
    ("rad", Dimension.ANGLE, 1.0, ("radian", "radians")),
    ("deg", Dimension.ANGLE, _DEGREE, ("degree", "degrees", "degs")),
    ("mrad", Dimension.ANGLE, 1e-3, ()),
    ("rad/s", Dimension.ANGULAR_RATE, 1.0, ("rad/sec", "rads/s", "radian/s", "radians/s", "radps")),
    ("deg/s", Dimension.ANGULAR_RATE, _DEGREE, ("deg/sec", "dps", "degps", "degs/s", "degree/s", "degrees/s",
                                                "degree/sec", "degrees/sec")),
    ("mrad/s", Dimension.ANGULAR_RATE, 1e-3, ("mrad/sec",)),
    ("m/s^2", Dimension.ACCELERATION, 1.0, ("m/s2", "m/s/s", "m/sec2", "m/sec^2", "m/ss", "mps2", "mpss")),
    ("g", Dimension.ACCELERATION, 9.80665, ()),
)  # fmt: skip
_BY_SPELLING = {
    spelling: Unit(name, dimension, to_si)
    for name, dimension, to_si, spellings in _UNITS
    for spelling in (name, *spellings)
}


def parse_unit(text: str | None) -> Unit | None:
    """Return the unit that a DBC or a mapping spells, None for an unknown spelling."""
    if text is None:
        return None
    # a degree sign that was written as UTF-8 and read as Latin-1 has an A with circumflex before it
    plain = "".join(text.lower().replace("\u00e2\u00b0", "deg").split())
    plain = plain.replace("\u00b0", "deg").replace("\u00ba", "deg").replace("\u00b2", "2")
    return _BY_SPELLING.get(plain)


def known_units(dimension: Dimension) -> str:
    """Return the usual spellings of a dimension's units, for messages."""
    return ", ".join(name for name, measures, _, _ in _UNITS if measures is dimension)
