"""Tables of wall reflectance by FDTD: specular and total power over angle, roughness, polarisation and band.

They are the check of the closed form that the ray tracer uses: exact stack of layers times Kirchhoff's factor, alpha =
|r|^2 exp(-g^2) with g = 4 pi s cos / lambda. Smooth walls come from one column of cells, rough ones from strips of
random surfaces, several seeds a cell. The specular field r_0 of one finite surface is its mean plus a share of the
diffuse field, so the mean over seeds settles slowly. Kirchhoff's sum over the very same surface, mean exp(-2jk h cos),
carries nearly the same chance and has a known mean, exp(-g^2/2): it serves as control variate.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import msgspec
import numpy as np

from lab.full_wave.media import Layers
from lab.full_wave.rough import RoughParams, cell_size, is_conductor, quiet_width, rough_profile, scatter
from lab.full_wave.scattering import reflect_angles
from models.physics.fresnel import Polarisation, coherent_power, stack_reflection
from models.physics.materials import band_note, wall_layers
from msgs.files.array_files import load_arrays
from msgs.values.units import SPEED_OF_LIGHT_MPS
from sim_player.dataset.executors import map_jobs

#: The shipped table; its card lies beside it.
SHIPPED = Path(__file__).parents[1] / "tables" / "reflectance.npz"
POLARISATIONS: tuple[Polarisation, ...] = get_args(Polarisation)
BANDS_HZ = (10e9, 77e9)
#: Name, material, thickness [m] (None: half-space, or a construction with layers of its own).
WALLS: dict[str, tuple[str, float | None]] = {
    "concrete": ("concrete", 0.25),
    "brick": ("brick", 0.24),
    "glass": ("glass", 6e-3),
    "wood": ("wood", 0.04),
    "plasterboard": ("plasterboard", 12.5e-3),
    "metal": ("container", None),
    "asphalt": ("asphalt", None),
}
SMOOTH_ANGLES_DEG = np.arange(0.0, 85.1, 0.5)
ROUGH_ANGLES_DEG = np.array([0.0, 30.0, 60.0])
#: Rms heights [m] of each band: from the first visible effect of roughness to the near loss of the mirror.
ROUGHNESS_M = {10e9: (1e-3, 2e-3, 4e-3), 77e9: (0.1e-3, 0.2e-3, 0.5e-3)}
#: Rough walls that are run: elsewhere the engine refuses, rings, or the result adds too little for its cost.
ROUGH_RUNS: tuple[tuple[str, float, Polarisation], ...] = (
    ("concrete", 10e9, "te"),
    ("concrete", 10e9, "tm"),
    ("brick", 10e9, "te"),
    ("plasterboard", 10e9, "te"),
    ("metal", 10e9, "te"),
    ("concrete", 77e9, "te"),
    ("concrete", 77e9, "tm"),
    ("plasterboard", 77e9, "te"),
    ("metal", 77e9, "te"),
)
#: Rough walls that are left out at the steepest angle, which costs as much as all others together.
SPARED_RUNS: tuple[tuple[str, float, Polarisation], ...] = (("brick", 10e9, "te"),)
#: Correlation length of the heights in wavelengths, and seeds of the surfaces of one cell.
CORRELATION_WAVELENGTHS, SEEDS = 4.0 / 3.0, (0, 1, 2)
#: Cells per wavelength: smooth, rough dielectric, rough metal (whose stairs want finer cells; none lie inside it).
SMOOTH_CELLS, ROUGH_CELLS, METAL_CELLS = 20.0, 16.0, 30.0
#: Settings that fix a result beside its entry: a stopped build resumes only under the same.
SETTINGS = (SMOOTH_CELLS, ROUGH_CELLS, METAL_CELLS, CORRELATION_WAVELENGTHS)
#: A layer with more loss there and back is cut to a half-space.
OPAQUE_DB = 80.0
#: A rough cell is left out where its standard error is above this, or its field is still above this share of its peak.
MAX_ERROR_DB, MAX_RESIDUE = 1.5, 1e-3
#: Agreement with the closed form that `compare` counts.
AGREEMENT_DB = 0.5
#: Status of a rough cell by the code in the table.
MEASURED, NOT_RUN, REFUSED, UNSURE, RINGING = range(5)
STATUS = (
    "measured",
    "not run: left out for its cost",
    "refused by the engine: stairs of cells on a rough good conductor guide waves in tm",
    f"specular lobe too weak: its standard error over the seeds is above {MAX_ERROR_DB} dB",
    f"the field had not left by the end of the run: above {MAX_RESIDUE:g} of its peak",
)


class Entry(msgspec.Struct, frozen=True):
    """One thing to simulate: a wall in a band and polarisation at angles; smooth if roughness_m is 0."""

    wall: str
    frequency_hz: float
    polarisation: Polarisation
    roughness_m: float
    angles_deg: tuple[float, ...]
    seeds: tuple[int, ...] = SEEDS

    def __post_init__(self) -> None:
        if self.wall not in WALLS:
            raise ValueError(f"wall must be one of {', '.join(WALLS)}, got {self.wall!r}")
        if not (self.roughness_m >= 0.0 and self.angles_deg):
            raise ValueError(f"an entry needs roughness_m >= 0 and an angle, got {self!r}")
        if self.roughness_m > 0.0 and len(self.seeds) < 2:
            raise ValueError(f"a rough entry needs two seeds or more, got {self.seeds!r}")


class Cell(msgspec.Struct, frozen=True):
    """Result of one entry and angle; field and powers of rough walls are shares of the smooth wall's.

    lobe and lobe_spread: mean and standard deviation over the seeds of |r_0|^2 as it is; specular and error_db: power
    of the mean field by the control variate and its standard error.
    """

    angle_deg: float
    r: tuple[float, float] = (0.0, 0.0)
    specular: float = 0.0
    error_db: float = 0.0
    lobe: float = 0.0
    lobe_spread: float = 0.0
    reflected: float = 0.0
    residue: float = 0.0


class Done(msgspec.Struct, frozen=True):
    """An entry and its cells: one line of the file from which a stopped build resumes."""

    entry: Entry
    cells: tuple[Cell, ...]
    settings: tuple[float, ...] = SETTINGS


@dataclass(frozen=True)
class Comparison:
    """FDTD minus closed form [dB] over the angles of one wall, band, polarisation and roughness."""

    wall: str
    frequency_hz: float
    polarisation: Polarisation
    roughness_m: float
    angles_deg: np.ndarray
    difference_db: np.ndarray
    error_db: np.ndarray
    absent: int

    @property
    def worst(self) -> tuple[float, float, float]:
        """Largest difference [dB], its standard error [dB] and its angle [deg]; nan where nothing was measured."""
        if not len(self.difference_db):
            return math.nan, math.nan, math.nan
        index = int(np.abs(self.difference_db).argmax())
        return float(self.difference_db[index]), float(self.error_db[index]), float(self.angles_deg[index])

    @property
    def agreeing(self) -> int:
        """Angles within AGREEMENT_DB."""
        return int(np.count_nonzero(np.abs(self.difference_db) <= AGREEMENT_DB))


@dataclass(frozen=True)
class ReflectanceTable:
    """Axes W walls, F bands, P polarisations, A smooth angles, L roughness levels of the band, B rough angles."""

    walls: tuple[str, ...]
    bands_hz: tuple[float, ...]
    smooth_angle_deg: np.ndarray  # [A]
    rough_angle_deg: np.ndarray  # [B]
    roughness_m: np.ndarray  # [F, L]
    #: Complex field reflection of smooth walls, complex64 [W, F, P, A]; nan where not run.
    smooth_r: np.ndarray
    #: Codes of STATUS, uint8 [W, F, P, L, B], and shares of what the smooth wall reflects specularly, float32 likewise.
    status: np.ndarray
    specular_share: np.ndarray
    error_db: np.ndarray
    lobe_share: np.ndarray
    lobe_spread: np.ndarray
    reflected_share: np.ndarray
    card: dict[str, Any]

    ARRAYS = (
        *("smooth_angle_deg", "rough_angle_deg", "roughness_m", "smooth_r", "status"),
        *("specular_share", "error_db", "lobe_share", "lobe_spread", "reflected_share"),
    )

    def compare(self) -> list[Comparison]:
        """Return the FDTD minus |r_exact|^2 exp(-g^2), one row a wall, band, polarisation and roughness that was
        run.
        """
        return list(self._comparisons())

    def absent(self) -> list[tuple[str, float, Polarisation, float, float, str]]:
        """Return the rough cells without a value: wall, band [Hz], polarisation, roughness [m], angle [deg], reason."""
        absent = []
        for w, f, p, level, b in np.argwhere(self.status != MEASURED):
            setting = float(self.roughness_m[f, level]), float(self.rough_angle_deg[b])
            reason = STATUS[self.status[w, f, p, level, b]]
            absent.append((self.walls[w], self.bands_hz[f], POLARISATIONS[p], *setting, reason))
        return absent

    def to_bytes(self) -> bytes:
        """Return the arrays as npz; equal tables give equal bytes."""
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **{name: getattr(self, name) for name in self.ARRAYS})
        return buffer.getvalue()

    def save(self, path: Path, provenance: dict[str, Any]) -> None:
        """Write PATH (npz) and its card beside it (json), with the checksum and what `provenance` adds."""
        data = self.to_bytes()
        card = {"file": path.name, "sha256": hashlib.sha256(data).hexdigest(), **provenance, **self.card}
        path.write_bytes(data)
        path.with_suffix(".json").write_text(json.dumps(card, indent=1) + "\n")

    def _comparisons(self) -> Iterator[Comparison]:
        for w, f, p in np.ndindex(*self.smooth_r.shape[:3]):
            wall, band_hz, polarisation = self.walls[w], self.bands_hz[f], POLARISATIONS[p]
            smooth_db = _power_db(self.smooth_r[w, f, p])
            is_measured = np.isfinite(smooth_db)
            if is_measured.any():
                media, thicknesses_m = zip(*layers_of(wall, band_hz), strict=True)
                cosine = np.cos(np.radians(self.smooth_angle_deg))
                r = stack_reflection(media, thicknesses_m, cosine, SPEED_OF_LIGHT_MPS / band_hz, polarisation)
                exact_db = _power_db(r) + _factor_db(0.0, self.smooth_angle_deg, band_hz)
                angles_deg, difference_db = self.smooth_angle_deg[is_measured], (smooth_db - exact_db)[is_measured]
                zero = np.zeros_like(difference_db)
                yield Comparison(
                    wall, band_hz, polarisation, 0.0, angles_deg, difference_db, zero, int((~is_measured).sum())
                )
            for level, roughness_m in enumerate(self.roughness_m[f]):
                status = self.status[w, f, p, level]
                if np.isin(status, (NOT_RUN, REFUSED)).all():
                    continue
                here = status == MEASURED
                angles_deg = self.rough_angle_deg[here]
                factor_db = _factor_db(roughness_m, angles_deg, band_hz)
                difference_db = 10.0 * np.log10(self.specular_share[w, f, p, level, here]) - factor_db
                error_db = self.error_db[w, f, p, level, here]
                absent = int((~here).sum())
                yield Comparison(
                    wall, band_hz, polarisation, float(roughness_m), angles_deg, difference_db, error_db, absent
                )


def table_entries() -> list[Entry]:
    """Return the entries of the shipped table, short runs first; a rough entry is one angle."""
    smooth = tuple(float(angle) for angle in SMOOTH_ANGLES_DEG)
    entries = [Entry(wall, band, pol, 0.0, smooth) for wall in WALLS for band in BANDS_HZ for pol in POLARISATIONS]
    for angle in ROUGH_ANGLES_DEG:
        for run in ROUGH_RUNS:
            if angle == ROUGH_ANGLES_DEG[-1] and run in SPARED_RUNS:
                continue
            entries += [Entry(*run, roughness_m, (float(angle),)) for roughness_m in ROUGHNESS_M[run[1]]]
    return entries


def build_tables(
    entries: Sequence[Entry],
    on_progress: Callable[[int, int], None] | None = None,
    partial: Path | None = None,
    workers: int = 1,
) -> ReflectanceTable:
    """Simulate entries and sort them into a table; `on_progress(done, all)` is called after each.

    `partial`: a file that keeps what is done, line by line; entries found there are not simulated again. Same table
    for any number of workers. Raises ValueError for what the engine refuses.
    """
    done = {} if partial is None else _read_partial(partial)
    done = {entry: done[entry] for entry in entries if entry in done}
    todo = [entry for entry in entries if entry not in done]
    if on_progress is not None:
        on_progress(len(done), len(entries))
    for result in map_jobs(simulate, todo, workers=workers):
        done[result.entry] = result.cells
        if partial is not None:
            with partial.open("ab") as file:
                file.write(msgspec.json.encode(result) + b"\n")
        if on_progress is not None:
            on_progress(len(done), len(entries))
    return _as_table(entries, done)


def load_table(path: Path = SHIPPED) -> ReflectanceTable:
    """Read a table and its card; ValueError where the file is not the one the card describes, or either is none."""
    card, data = _load_card(path.with_suffix(".json")), path.read_bytes()
    digest = hashlib.sha256(data).hexdigest()
    if digest != card["sha256"]:
        raise ValueError(f"{path}: SHA-256 must be that of its card, {card['sha256']}, got {digest}")
    try:
        values = load_arrays(io.BytesIO(data), ReflectanceTable.ARRAYS)
    except ValueError as error:
        raise ValueError(f"{path}: must be a readable table: {error}") from None
    missing = [name for name in ReflectanceTable.ARRAYS if name not in values]
    if missing:
        raise ValueError(f"{path}: must hold {', '.join(ReflectanceTable.ARRAYS)}, lacks {', '.join(missing)}")
    bands_hz = tuple(1e9 * band for band in card["bands_ghz"])
    return ReflectanceTable(tuple(row["name"] for row in card["walls"]), bands_hz, **values, card=card)


class _Wall(msgspec.Struct):
    name: str


class _Card(msgspec.Struct):
    """Required fields of a table's card; it may have more."""

    sha256: str
    bands_ghz: list[float]
    walls: list[_Wall]


def _load_card(path: Path) -> dict[str, Any]:
    try:
        msgspec.json.decode(data := path.read_bytes(), type=_Card)
        card: dict[str, Any] = json.loads(data)
        return card
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise ValueError(f"{path}: {error}") from None


def layers_of(wall: str, frequency_hz: float) -> Layers:
    """Return the layers of a table's wall, beyond the range of its material too."""
    material, thickness_m = WALLS[wall]
    return wall_layers(material, thickness_m, frequency_hz, extrapolate=True)


def simulate(entry: Entry) -> Done:
    """Run one entry."""
    layers = cut_opaque(layers_of(entry.wall, entry.frequency_hz), entry.frequency_hz)
    if entry.roughness_m > 0.0:
        return Done(entry, tuple(_rough_cell(entry, layers, angle_deg) for angle_deg in entry.angles_deg))
    angles_rad = np.radians(entry.angles_deg)
    settings = RoughParams(SMOOTH_CELLS, dtype="float64")
    runs = reflect_angles(layers, angles_rad, entry.frequency_hz, entry.polarisation, settings, workers=1)
    return Done(
        entry,
        tuple(
            Cell(angle_deg, (run.r.real, run.r.imag), residue=run.residue)
            for angle_deg, run in zip(entry.angles_deg, runs, strict=True)
        ),
    )


def cut_opaque(layers: Layers, frequency_hz: float) -> Layers:
    """Return the layers down to the first opaque one (OPAQUE_DB), which becomes a half-space."""
    for index, (eps, depth_m) in enumerate(layers):
        # the path straight through has the least loss
        decay_per_m = -2.0 * math.pi * frequency_hz / SPEED_OF_LIGHT_MPS * np.sqrt(complex(eps)).imag
        if 20.0 / math.log(10.0) * 2.0 * decay_per_m * depth_m > OPAQUE_DB:
            return (*layers[:index], (eps, math.inf))
    return layers


def mirror_field(ratio: np.ndarray, kirchhoff: np.ndarray, phase_rad: float) -> tuple[complex, float]:
    """Return the mean field of a rough wall and its standard error, from r_0 of surfaces and their Kirchhoff sums,
    both [seeds].

    With g = phase_rad: mean(r_0) - beta (mean(K) - exp(-g^2/2)), beta the least-squares slope of r_0 on K; the
    error is that of the part that K does not explain.
    """
    slope = np.vdot(kirchhoff, ratio) / np.vdot(kirchhoff, kirchhoff)
    mean = ratio.mean() - slope * (kirchhoff.mean() - math.exp(-0.5 * phase_rad**2))
    left = ratio - slope * kirchhoff
    error = math.sqrt(float(np.sum(np.abs(left - left.mean()) ** 2)) / (len(left) - 1) / len(left))
    return complex(mean), error


def _rough_cell(entry: Entry, layers: Layers, angle_deg: float) -> Cell:
    """Return the surfaces of all seeds at one angle, against the smooth wall."""
    angle_rad, wavelength_m = math.radians(angle_deg), SPEED_OF_LIGHT_MPS / entry.frequency_hz
    cells = METAL_CELLS if any(is_conductor(eps) for eps, _ in layers) else ROUGH_CELLS
    correlation_m = CORRELATION_WAVELENGTHS * wavelength_m
    cell_m = cell_size(layers, wavelength_m, cells)
    width_m = round(quiet_width(12.0 * correlation_m, math.sin(angle_rad), wavelength_m) / cell_m) * cell_m
    case = (layers, angle_rad, entry.frequency_hz, entry.polarisation)
    smooth = _reference(*case, cells)
    power = abs(smooth) ** 2
    phase_rad = 4.0 * math.pi * entry.roughness_m * math.cos(angle_rad) / wavelength_m
    ratio, kirchhoff, reflected, residue = [], [], [], 0.0
    for seed in entry.seeds:
        run = scatter(*case, RoughParams(cells, entry.roughness_m, correlation_m, width_m, seed))
        unit = rough_profile(width_m, 1.0, correlation_m, seed, width_m * np.arange(4096) / 4096.0)
        ratio.append(run.r / smooth)
        kirchhoff.append(np.mean(np.exp(-1j * phase_rad * unit)))
        reflected.append(float(run.reflected.sum()) / power)
        residue = max(residue, run.residue)
    mean, error = mirror_field(np.array(ratio), np.array(kirchhoff), phase_rad)
    lobe = np.square(np.abs(ratio))
    return Cell(
        angle_deg,
        (mean.real, mean.imag),
        abs(mean) ** 2,
        20.0 * math.log10(1.0 + error / max(abs(mean), 1e-30)),
        float(lobe.mean()),
        float(lobe.std(ddof=1)),
        float(np.mean(reflected)),
        residue,
    )


def _reference(
    layers: Layers, angle_rad: float, frequency_hz: float, polarisation: Polarisation, cells: float
) -> complex:
    """Return the reflection of the smooth wall that a rough one is compared with.

    A slab's on the same cells, which move its resonance. A half-space has none, and its face lies on nodes, which a
    rough face does not: there the exact value is nearer.
    """
    if len(layers) > 1 or math.isfinite(layers[0][1]):
        case = (layers, angle_rad, frequency_hz, polarisation)
        return scatter(*case, RoughParams(cells, dtype="float64")).r
    cosine, wavelength_m = np.asarray(math.cos(angle_rad)), SPEED_OF_LIGHT_MPS / frequency_hz
    return complex(stack_reflection([layers[0][0]], [math.inf], cosine, wavelength_m, polarisation))


def _read_partial(path: Path) -> dict[Entry, tuple[Cell, ...]]:
    """Return the entries done by an earlier build under the same settings; an incomplete last line is skipped."""
    if not path.exists():
        return {}
    cells = {}
    for line in path.read_bytes().splitlines():
        try:
            result = msgspec.json.decode(line, type=Done)
        except msgspec.MsgspecError:
            continue
        if result.settings == SETTINGS:
            cells[result.entry] = result.cells
    return cells


def _as_table(entries: Sequence[Entry], done: dict[Entry, tuple[Cell, ...]]) -> ReflectanceTable:
    """Sort the cells; axes are those that the entries span."""
    walls = tuple(name for name in WALLS if any(entry.wall == name for entry in entries))
    bands_hz = tuple(sorted({entry.frequency_hz for entry in entries}))
    smooth_deg = np.array(sorted({a for entry in entries if entry.roughness_m == 0.0 for a in entry.angles_deg}))
    rough_deg = np.array(sorted({a for entry in entries if entry.roughness_m > 0.0 for a in entry.angles_deg}))
    levels = [sorted({e.roughness_m for e in entries if e.frequency_hz == band} - {0.0}) for band in bands_hz]
    if len({len(row) for row in levels}) > 1:
        raise ValueError(f"bands must have as many roughness levels each, got {levels!r}")
    roughness_m = np.array(levels).reshape(len(bands_hz), -1)
    shape = (len(walls), len(bands_hz), len(POLARISATIONS))
    wide = (*shape, roughness_m.shape[1], len(rough_deg))
    smooth_r = np.full((*shape, len(smooth_deg)), np.nan, np.complex64)
    status = np.full(wide, NOT_RUN, np.uint8)
    status[_refused(walls, bands_hz)] = REFUSED
    values = {name: np.full(wide, np.nan, np.float32) for name in ReflectanceTable.ARRAYS[5:]}
    for entry in entries:
        at = walls.index(entry.wall), bands_hz.index(entry.frequency_hz), POLARISATIONS.index(entry.polarisation)
        for cell in done[entry]:
            if entry.roughness_m == 0.0:
                smooth_r[at][np.searchsorted(smooth_deg, cell.angle_deg)] = complex(*cell.r)
                continue
            level = levels[at[1]].index(entry.roughness_m)
            _place(cell, (*at, level, int(np.searchsorted(rough_deg, cell.angle_deg))), status, values)
    card = _described(walls, bands_hz, roughness_m, smooth_deg, rough_deg, status)
    return ReflectanceTable(walls, bands_hz, smooth_deg, rough_deg, roughness_m, smooth_r, status, **values, card=card)


def _place(cell: Cell, at: tuple[int, ...], status: np.ndarray, values: dict[str, np.ndarray]) -> None:
    """Put a rough cell into the table; an unreliable one keeps its lobe alone, its mean field is left out."""
    unsure = not cell.error_db <= MAX_ERROR_DB
    status[at] = RINGING if cell.residue > MAX_RESIDUE else UNSURE if unsure else MEASURED
    if status[at] == RINGING:
        return
    values["lobe_share"][at], values["lobe_spread"][at] = cell.lobe, cell.lobe_spread
    values["reflected_share"][at], values["error_db"][at] = cell.reflected, cell.error_db
    if status[at] == MEASURED:
        values["specular_share"][at] = cell.specular


def _refused(walls: tuple[str, ...], bands_hz: tuple[float, ...]) -> np.ndarray:
    """Return the combinations without rough walls in the engine, bool [W, F, P]."""
    metal = [[any(is_conductor(eps) for eps, _ in layers_of(wall, band)) for band in bands_hz] for wall in walls]
    return np.array(metal)[:, :, None] & (np.array(POLARISATIONS) == "tm")


def _described(
    walls: tuple[str, ...],
    bands_hz: tuple[float, ...],
    roughness_m: np.ndarray,
    smooth_deg: np.ndarray,
    rough_deg: np.ndarray,
    status: np.ndarray,
) -> dict[str, Any]:
    """Return the part of the card that follows from the table."""
    return {
        "walls": [{"name": wall, "built_of": _built_of(wall), "bands": _media_of(wall, bands_hz)} for wall in walls],
        "bands_ghz": [band / 1e9 for band in bands_hz],
        "smooth_angles_deg": [float(smooth_deg[0]), float(smooth_deg[-1]), len(smooth_deg)] if len(smooth_deg) else [],
        "rough_angles_deg": rough_deg.tolist(),
        "roughness_mm": np.round(1e3 * roughness_m, 6).tolist(),
        "smooth": {"cells_per_wavelength": SMOOTH_CELLS, "dtype": "float64"},
        "rough": {
            "cells_per_wavelength": ROUGH_CELLS,
            "cells_per_wavelength_metal": METAL_CELLS,
            "dtype": "float32",
            "seeds": list(SEEDS),
            "correlation_mm": [1e3 * CORRELATION_WAVELENGTHS * SPEED_OF_LIGHT_MPS / band for band in bands_hz],
            "width": "12 correlation lengths and up to a wavelength more",
        },
        "opaque_db": OPAQUE_DB,
        "status": {name: int(np.count_nonzero(status == code)) for code, name in enumerate(STATUS)},
    }


def _built_of(wall: str) -> str:
    material, thickness_m = WALLS[wall]
    return material if thickness_m is None else f"{material} {1e3 * thickness_m:g} mm"


def _media_of(wall: str, bands_hz: tuple[float, ...]) -> list[dict[str, Any]]:
    """Return the permittivity of the front layer in each band, and what is interpolated, extrapolated or cut."""
    rows = []
    for band in bands_hz:
        layers = layers_of(wall, band)
        eps = complex(layers[0][0])
        opacity_note = "opaque: simulated as a half-space" if cut_opaque(layers, band) != layers else ""
        note = ", ".join(part for part in (band_note(WALLS[wall][0], band), opacity_note) if part)
        rows.append({"ghz": band / 1e9, "permittivity": [eps.real, eps.imag], "note": note})
    return rows


def _factor_db(roughness_m: float, angles_deg: np.ndarray, frequency_hz: float) -> np.ndarray:
    """Return the Kirchhoff's factor [dB]."""
    cosine = np.cos(np.radians(angles_deg))
    return 10.0 * np.log10(coherent_power(np.asarray(roughness_m), cosine, SPEED_OF_LIGHT_MPS / frequency_hz))


def _power_db(field: np.ndarray) -> np.ndarray:
    return 20.0 * np.log10(np.abs(np.asarray(field, np.complex128)))
