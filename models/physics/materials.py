"""Materials of walls and grounds: complex permittivity by ITU-R P.2040, Table 3.

eps = a f^b - j sigma / (2 pi f eps0), sigma = c f^d, f in GHz. Each row says where it was measured; beyond that it is
refused unless extrapolation is asked for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

VACUUM_PERMITTIVITY_F_PER_M = 8.854_187_812_8e-12


@dataclass(frozen=True)
class MaterialRow:
    """One row of the table: coefficients a, b (permittivity), c, d (conductivity, S/m), validity in GHz."""

    a: float
    b: float
    c: float
    d: float
    least_ghz: float
    most_ghz: float


#: Some materials have a second row for a higher band.
TABLE: dict[str, tuple[MaterialRow, ...]] = {
    "vacuum": (MaterialRow(1.0, 0.0, 0.0, 0.0, 0.001, 100.0),),
    "concrete": (
        MaterialRow(5.24, 0.0, 0.0462, 0.7822, 1.0, 100.0),
        MaterialRow(5.17, 0.0, 0.0145, 1.09, 110.0, 330.0),
    ),
    "brick": (
        MaterialRow(3.91, 0.0, 0.0238, 0.16, 1.0, 40.0),
        MaterialRow(4.15, 0.0, 0.0006, 1.5712, 110.0, 330.0),
    ),
    "plasterboard": (MaterialRow(2.73, 0.0, 0.0085, 0.9395, 1.0, 100.0),),
    "wood": (MaterialRow(1.99, 0.0, 0.0047, 1.0718, 0.001, 100.0),),
    "glass": (
        MaterialRow(6.31, 0.0, 0.0036, 1.3394, 0.1, 100.0),
        MaterialRow(5.79, 0.0, 0.0004, 1.658, 220.0, 450.0),
    ),
    "ceiling_board": (MaterialRow(1.48, 0.0, 0.0011, 1.0750, 1.0, 100.0),),
    "chipboard": (MaterialRow(2.58, 0.0, 0.0217, 0.7800, 1.0, 100.0),),
    "plywood": (MaterialRow(2.71, 0.0, 0.33, 0.0, 1.0, 40.0),),
    "marble": (MaterialRow(7.074, 0.0, 0.0055, 0.9262, 1.0, 60.0),),
    "floorboard": (MaterialRow(3.66, 0.0, 0.0044, 1.3515, 50.0, 100.0),),
    "metal": (MaterialRow(1.0, 0.0, 1e7, 0.0, 1.0, 100.0),),
    "very_dry_ground": (MaterialRow(3.0, 0.0, 0.00015, 2.52, 1.0, 10.0),),
    "medium_dry_ground": (MaterialRow(15.0, -0.1, 0.035, 1.63, 1.0, 10.0),),
    "wet_ground": (MaterialRow(30.0, -0.4, 0.15, 1.30, 1.0, 10.0),),
}

ALIASES: dict[str, str] = {
    "air": "vacuum",
    "bricks": "brick",
    "cement": "concrete",
    "steel": "metal",
    "aluminium": "metal",
    "window": "glass",
    "timber": "wood",
    "drywall": "plasterboard",
    "dry_ground": "medium_dry_ground",
    "ground": "medium_dry_ground",
}


def material_name(name: str) -> str:
    """The table's name of a material or alias ("Very dry ground", "steel"); ValueError lists the known ones."""
    key = name.strip().lower().replace(" ", "_").replace("-", "_")
    key = ALIASES.get(key, key)
    if key not in TABLE:
        raise ValueError(f"unknown material {name!r}, known are {', '.join(TABLE)}")
    return key


def permittivity(name: str, frequency_hz: float, extrapolate: bool = False) -> complex:
    """Complex relative permittivity, Im <= 0.

    Both ends of a validity range belong to it. Outside, ValueError, or the nearest row if `extrapolate`.
    """
    if not (math.isfinite(frequency_hz) and frequency_hz > 0.0):
        raise ValueError(f"frequency_hz must be finite and positive, got {frequency_hz!r}")
    key = material_name(name)
    frequency_ghz = frequency_hz / 1e9
    row = min(TABLE[key], key=lambda row: _outside(row, frequency_ghz))
    if _outside(row, frequency_ghz) > 0.0 and not extrapolate:
        ranges = " and ".join(f"{row.least_ghz:g}..{row.most_ghz:g}" for row in TABLE[key])
        raise ValueError(f"material {key} is known for {ranges} GHz, got {frequency_ghz:g} GHz")
    conductivity = row.c * frequency_ghz**row.d
    loss = conductivity / (2.0 * math.pi * frequency_hz * VACUUM_PERMITTIVITY_F_PER_M)
    return complex(row.a * frequency_ghz**row.b, -loss)


def _outside(row: MaterialRow, frequency_ghz: float) -> float:
    """How far, as a ratio's logarithm, a frequency lies outside a row's range; zero inside."""
    return max(math.log(row.least_ghz / frequency_ghz), math.log(frequency_ghz / row.most_ghz), 0.0)
