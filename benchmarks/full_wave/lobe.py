"""Diffuse lobe of rough concrete over all angles: a wide strip's Floquet orders beside Lambert's and Kirchhoff's lobe.

A plane wave falls square on a half space whose front is rough; the power of each order, over the smooth front's mirror,
is what the lobe in the plane sends into the order's share of angle. Mirror images about the normal count together.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from benchmarks.full_wave.scenes import RADAR, ROUGH_M
from lab.full_wave.rough import FloquetOrders, RoughParams, quiet_width, scatter
from models.physics.materials import permittivity
from models.physics.rough_lobe import RoughLobe
from models.physics.roughness import diffuse_share

CORRELATION_M = 0.03
CELLS_PER_WAVELENGTH = 16.0
#: Angles from the normal of the bins of a row; the first leaves out the mirror's own order.
ANGLES_DEG = (0, 10, 20, 30, 40, 50, 60, 70)
WIDTH_M = quiet_width(16.0 * CORRELATION_M, 0.0, RADAR.wavelength_m)


@dataclass(frozen=True)
class LobeRow:
    """Power between two angles from the normal, over the smooth mirror: full wave and both lobes over it [dB]."""

    roughness_mm: float
    draws: int
    angles_deg: tuple[float, float]
    wave_db: float
    #: Standard error of the mean over draws.
    error_db: float
    lambert_db: float
    kirchhoff_db: float


def lobe_rows(draws: int, seed: int, work: Path) -> list[LobeRow]:
    """Return the rows of every roughness, from strips that `work` holds or that are computed."""
    return [row for roughness_m in ROUGH_M.values() for row in _rows(roughness_m, range(seed, seed + draws), work)]


def _rows(roughness_m: float, draws: range, work: Path) -> list[LobeRow]:
    strips = np.array([_strip(roughness_m, draw, work) for draw in draws])
    sine, power = strips[0, 0], strips[:, 1]
    angle_deg = np.degrees(np.arcsin(np.abs(sine)))
    lambert, kirchhoff = _laws(roughness_m, sine)
    rows = []
    for low, high in pairwise(ANGLES_DEG):
        inside = (angle_deg >= low) & (angle_deg < high) & (np.abs(sine) > 1e-6)
        wave = power[:, inside].sum(axis=1)
        mean = wave.mean()
        error = wave.std(ddof=1) / mean / math.sqrt(len(draws)) if len(draws) > 1 else math.inf
        levels = [10.0 * math.log10(law[inside].sum() / mean) for law in (lambert, kirchhoff)]
        level_db, error_db = 10.0 * math.log10(mean), 10.0 * math.log10(1.0 + error)
        rows.append(LobeRow(1e3 * roughness_m, len(draws), (low, high), level_db, error_db, *levels))
    return rows


def _laws(roughness_m: float, sine: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the share of the smooth mirror's power that each lobe sends into orders of sines, [orders] each."""
    cosine = np.sqrt(1.0 - sine**2)
    share_rad = RADAR.wavelength_m / (WIDTH_M * cosine)
    lambert = 0.5 * diffuse_share(np.asarray(roughness_m), np.asarray(1.0), RADAR.wavelength_m) * cosine
    lobe = RoughLobe(roughness_m, CORRELATION_M, RADAR.wavelength_m, in_plane=True)
    kirchhoff = lobe.bistatic(np.ones(len(sine)), cosine, np.abs(sine)) / (2.0 * math.pi)
    return lambert * share_rad, kirchhoff * share_rad


def _strip(roughness_m: float, draw: int, work: Path) -> np.ndarray:
    """Return the sines of all orders of one draw, and their power over the smooth front's, [2, orders]."""
    path = work / f"strip-{1e3 * roughness_m:g}-{draw}.npy"
    if path.exists():
        return np.load(path)
    smooth, rough = (_orders(height_m, draw) for height_m in (0.0, roughness_m))
    orders = np.stack([np.sin(rough.reflected_angle_rad), rough.reflected / abs(smooth.r) ** 2])
    work.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part.npy")
    np.save(part, orders)
    os.replace(part, path)
    return orders


def _orders(roughness_m: float, draw: int) -> FloquetOrders:
    front = ((permittivity("concrete", RADAR.carrier_hz), math.inf),)
    params = RoughParams(CELLS_PER_WAVELENGTH, roughness_m, CORRELATION_M, WIDTH_M, draw)
    return scatter(front, 0.0, RADAR.carrier_hz, "te", params)
