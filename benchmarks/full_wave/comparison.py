"""Rays against the full wave, path group by path group, with all effects and with each one left out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.full_wave.line_source import LineEcho, thread_amplitude
from benchmarks.full_wave.rays import RayField, ray_field
from benchmarks.full_wave.scenes import RADAR, THREAD_PERMITTIVITY, MiniScene
from benchmarks.full_wave.waves import Waves
from msgs.values.units import SPEED_OF_LIGHT_MPS
from sim_player.effects.table import WEIGHTS
from sim_player.trace.effect_names import PATH_EFFECTS

#: The chirp's sweep; the full wave is read at so many frequencies.
SWEEP_HZ = RADAR.carrier_hz + RADAR.bandwidth_hz * np.linspace(-0.5, 0.5, 29)
#: A wider band for the picture, where groups shall stand apart; its steps tell delays up to 21 m apart.
PICTURE_HZ = RADAR.carrier_hz + 4e9 * np.linspace(-0.5, 0.5, 281)
#: Half length of a gate around an echo, and of its tapered ends: round trips.
GATE_M, TAPER_M = 0.15, 0.03
#: Half length of what must be recorded of a pulse, three deviations.
PULSE_M = 0.1
#: An echo names its gate where it lies this little below the gate's strongest.
NAMED_DB = 20.0
#: Those that the plane has: patches of a rough wall have random phases.
EFFECTS = frozenset({*PATH_EFFECTS, *WEIGHTS}) - {
    "ground_bounce", "object_interreflection", "vegetation", "atmosphere", "diffuse_scattering",
}  # fmt: skip


#: Echoes weaker than this below the strongest get no gate of their own: they would tie strong ones together.
GATED_DB = 50.0
#: What walls alone return.
WALL_GROUPS = ("flash", "end", "radar twice mirrored")


@dataclass(frozen=True)
class Group:
    """Echoes of one gate: level of the full wave under the strongest gate of all, and errors of the rays [dB, deg]."""

    scene: str
    target: str
    name: str
    #: Round trip [m], first to last echo.
    delay_m: tuple[float, float]
    strength_db: float
    #: Level of the rays over the full wave, rms over the sweep, and the largest deviation of any frequency.
    level_db: float
    worst_db: float
    phase_deg: float
    #: Difference of both fields over the full wave.
    relative_db: float
    #: `level_db` with one effect left out, where that changes it; None: nothing is left.
    without: dict[str, float | None]


@dataclass(frozen=True)
class Remainder:
    """What the gates of a run leave over: its level and where it is strongest; the whole run's relative error."""

    scene: str
    target: str
    strength_db: float
    delay_m: float
    relative_db: float
    without: dict[str, float]


@dataclass(frozen=True)
class Comparison:
    """All groups of a run, what is left over, and the fields over delay for the picture."""

    groups: list[Group]
    remainder: Remainder
    delay_m: np.ndarray
    waves_db: np.ndarray
    rays_db: np.ndarray


def compare(scene: MiniScene, waves: Waves, target: str | None) -> Comparison:
    """Compare one run: the walls alone (None), or what a target adds to them."""
    echo = waves.walls if target is None else waves.targets[target]
    world = scene.world(None if target is None else scene.node_m(waves.grid, target))
    recorded_m = float(SPEED_OF_LIGHT_MPS * echo.time_s[-1]) - PULSE_M

    def rays(effects: frozenset[str], frequency_hz: np.ndarray = SWEEP_HZ) -> RayField:
        amplitude = thread_amplitude(waves.empty, frequency_hz, THREAD_PERMITTIVITY)
        field = ray_field(world, effects, waves.grid, frequency_hz, amplitude)
        field = field.take(field.delay_m < recorded_m)
        return field.take(np.isin(field.name, WALL_GROUPS, invert=target is not None))

    everything = rays(EFFECTS)
    lesser = {name: rays(EFFECTS - {name}) for name in sorted(EFFECTS)}
    lesser = {name: field for name, field in lesser.items() if not _same(field, everything)}
    gates = clusters(everything)
    found = [gated(echo, low, high) for low, high in gates]
    strongest = max(map(rms, found))
    label = target or "walls"
    groups = [
        _group((scene.name, label), gate, field, everything, lesser, strongest)
        for gate, field in zip(gates, found, strict=True)
    ]
    whole = echo.spectrum(SWEEP_HZ)
    outside = [1.0 - gate_of(echo, low, high) for low, high in gates]
    rest = echo.field * np.prod(outside, axis=0)
    remainder = Remainder(
        scene.name,
        label,
        db(rms(echo.spectrum(SWEEP_HZ, rest)) / strongest),
        float(SPEED_OF_LIGHT_MPS * echo.time_s[np.argmax(np.abs(rest))]),
        relative_db(everything.field.sum(axis=0), whole),
        {name: relative_db(field.field.sum(axis=0), whole) for name, field in lesser.items()},
    )
    return Comparison(
        groups, remainder, *profiles(echo.spectrum(PICTURE_HZ), rays(EFFECTS, PICTURE_HZ).field.sum(axis=0))
    )


def clusters(rays: RayField) -> list[tuple[float, float]]:
    """Return the first and last delay [m] of strong echoes that one gate must hold."""
    level = np.abs(rays.field).max(axis=1)
    delays = np.sort(rays.delay_m[level > 10.0 ** (-GATED_DB / 20.0) * level.max()])
    cut = np.flatnonzero(np.diff(delays) > 2.0 * GATE_M) + 1
    return [(float(part[0]), float(part[-1])) for part in np.split(delays, cut)]


def gate_of(echo: LineEcho, low_m: float, high_m: float) -> np.ndarray:
    """Return the gate around delays, 0..1 [steps], with cosine tapers."""
    return gate_weight(SPEED_OF_LIGHT_MPS * echo.time_s, low_m, high_m)


def gate_weight(delay_m: np.ndarray, low_m: float, high_m: float) -> np.ndarray:
    """Return the gate around delays at others, 0..1."""
    away = np.maximum(low_m - delay_m, delay_m - high_m)
    return np.asarray(0.5 + 0.5 * np.cos(np.pi * np.clip((away - GATE_M + TAPER_M) / TAPER_M, 0.0, 1.0)))


def gated(echo: LineEcho, low_m: float, high_m: float) -> np.ndarray:
    """Return the spectrum of the full wave around delays, [frequencies]."""
    return echo.spectrum(SWEEP_HZ, echo.field * gate_of(echo, low_m, high_m))


def _group(
    place: tuple[str, str],
    gate: tuple[float, float],
    wave: np.ndarray,
    everything: RayField,
    lesser: dict[str, RayField],
    strongest: float,
) -> Group:
    field, names = _within(everything, gate)
    rays = field.sum(axis=0)
    without = {name: _within(other, gate)[0].sum(axis=0) for name, other in lesser.items()}
    levels = {
        name: level_db(other, wave) if np.any(other) else None
        for name, other in without.items()
        if not np.allclose(other, rays, rtol=1e-6)
    }
    return Group(
        *place,
        names,
        gate,
        db(rms(wave) / strongest),
        level_db(rays, wave),
        float(np.abs(20.0 * np.log10(np.abs(rays / wave))).max()),
        float(np.degrees(np.angle(np.vdot(wave, rays)))),
        relative_db(rays, wave),
        levels,
    )


def _within(rays: RayField, gate: tuple[float, float]) -> tuple[np.ndarray, str]:
    """Return the echoes within a gate [E, frequencies], and the names of the strong ones."""
    inside = (rays.delay_m > gate[0] - GATE_M) & (rays.delay_m < gate[1] + GATE_M)
    field = rays.field[inside]
    level = np.abs(field).max(axis=1, initial=0.0)
    names = [rays.name[i] for i in np.flatnonzero(inside)]
    strong = [
        name for name, value in zip(names, level, strict=True) if value > 10.0 ** (-NAMED_DB / 20.0) * level.max()
    ]
    return field, " + ".join(dict.fromkeys(strong))


def profiles(*fields: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the delays [m] and the level [dB] of fields over them, of spectra at `PICTURE_HZ` under a Hann window."""
    size = 4096
    delay_m = np.arange(size) * SPEED_OF_LIGHT_MPS / ((PICTURE_HZ[1] - PICTURE_HZ[0]) * size)
    window = np.hanning(len(PICTURE_HZ) + 2)[1:-1]
    levels = [20.0 * np.log10(np.abs(np.fft.ifft(field * window, size)) * size / window.sum()) for field in fields]
    return delay_m, *levels


def _same(field: RayField, other: RayField) -> bool:
    return field.field.shape == other.field.shape and np.allclose(field.field, other.field, rtol=1e-9)


def rms(field: np.ndarray) -> float:
    """Return the root mean square over the sweep."""
    return float(np.sqrt(np.mean(np.abs(field) ** 2)))


def db(ratio: float) -> float:
    """Return a ratio of fields in dB."""
    return float(20.0 * np.log10(ratio))


def level_db(rays: np.ndarray, wave: np.ndarray) -> float:
    """Return the level of the rays over the full wave."""
    return db(rms(rays) / rms(wave))


def relative_db(rays: np.ndarray, wave: np.ndarray) -> float:
    """Return the difference of both over the full wave."""
    return db(rms(rays - wave) / rms(wave))
