"""Cases on which settings of the simulator are tried: random places, bodies, walls; and the best answer to each."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import msgspec
import numpy as np

from lab.full_wave.shot_rays import mesh_field
from lab.full_wave.smooth import SMOOTH_WALLS
from lab.tradeoff.literal_signal import literal_profiles
from msgs.values.radar import RadarSetup
from sim_player.bodies.meshes import primitive_mesh
from sim_player.effects.table import ALL_EFFECTS, PATHS, WEIGHTS, check_effects
from sim_player.generate.places import random_place
from sim_player.paths.ray_tracing import trace
from sim_player.planner.cells import Cells, cells_of
from sim_player.planner.plan import clean_profiles, manual_plan, noisy_profiles, plan_world
from sim_player.scene.world import prepare
from sim_player.signal.levels import beam_beats, hann_profiles, kernel_profiles, noise_profiles, noise_rms
from sim_player.signal.switches import PLAIN

Value = float | str
#: Every way by a mirror; without `specular_relay` the others have nothing to stand on.
MIRRORS = "specular_relay+curved_wall+second_relay+non_cofocal"
BUDGETS_DB = (-50.0, -40.0, -30.0, -20.0, -10.0, -3.0)
ANTENNA_AND_SWEEP = ("element_pattern", "quantised_phases", "mutual_coupling", "squint", "chirp_overlap")
ANGLES_DEG = np.arange(0.0, 81.0, 5.0)
#: Metal bodies that rays are shot at, metres.
BODIES: tuple[tuple[str, tuple[float, ...]], ...] = (
    ("dihedral", (0.3, 0.3)),
    ("trihedral", (0.3,)),
    ("sphere", (0.2,)),
    ("cylinder", (0.3, 0.5)),
    ("box", (0.5, 0.4, 0.3)),
)
#: Directions to each body, and rays a wavelength of the reference.
DIRECTIONS, MAX_RAYS = 4, 64.0
WAVELENGTH_M = RadarSetup().radar.wavelength_m
#: Ratio of cells that agree to the last bit.
SAME_DB = -300.0


class Clock:
    """Milliseconds of one run of one setting: `wall` and `cpu` of all parts, and `wall` of each."""

    def __init__(self) -> None:
        self.ms = {"wall": 0.0, "cpu": 0.0}

    @contextmanager
    def part(self, name: str, share: float = 1.0) -> Iterator[None]:
        """Time the body; where it is only a share of the work, scaled to the whole."""
        start_s = time.process_time()
        with self.aside(name, share):
            yield
        self.ms["wall"] += self.ms[name]
        self.ms["cpu"] += 1e3 * (time.process_time() - start_s) / share

    @contextmanager
    def aside(self, name: str, share: float = 1.0) -> Iterator[None]:
        """The same of what does not count towards the setting's own time."""
        start_s = time.perf_counter()
        yield
        self.ms[name] = 1e3 * (time.perf_counter() - start_s) / share


class Case(Protocol):
    """Case that all settings of a group share; common parts are made with it, before any setting is timed."""

    #: What it is, for people.
    name: str
    #: Settings too dear to be run more than once.
    once: frozenset[Value]

    def answer(self, value: Value, clock: Clock) -> Any:
        """Run one setting."""

    def truth(self, answers: dict[Value, Any]) -> Any:
        """The most complete answer, which may be one of the settings'."""

    def errors(self, answer: Any, truth: Any) -> dict[str, float]:
        """Return the errors of an answer, by measure."""


class _Place:
    """A random place at rest: number `index` of a series."""

    once: frozenset[Value] = frozenset()

    def __init__(self, seed: int, index: int, literal_beams: int) -> None:
        self.index = index
        self.world = prepare(random_place(seed, index), index)
        self.setup, self.name = self.world.setup, self.world.scene.name
        self.front_end = self.world.scene.radar.front_end

    @cached_property
    def cells(self) -> Cells:
        return cells_of(self.setup)

    @cached_property
    def rms(self) -> np.ndarray:
        """Noise rms with all effects, [bins]."""
        return noise_rms(self.setup, manual_plan(self.world, self.setup).signal, self.front_end)

    @cached_property
    def everything(self) -> np.ndarray:
        """Profiles with all effects and noise, as data sets hold them: kernel level, float32."""
        return noisy_profiles(manual_plan(self.world, self.setup), self.setup, self.index)

    def truth(self, answers: dict[Value, Any]) -> np.ndarray:
        """All effects."""
        return self.everything

    def errors(self, answer: np.ndarray, truth: np.ndarray) -> dict[str, float]:
        """The law's ratio in the worst and in the median cell of beams and map."""
        return _cell_errors(self.cells.off(truth, answer, self.rms))


def _cell_errors(ratio: np.ndarray) -> dict[str, float]:
    errors = {"worst_cell_db": ratio.max(), "median_cell_db": np.median(ratio)}
    return {name: float(20.0 * np.log10(max(value, 1e-15))) for name, value in errors.items()}


class _Levels(_Place):
    """One signal at three levels: echoes of all paths, without noise and what electronics add."""

    once: frozenset[Value] = frozenset({"literal"})

    def __init__(self, seed: int, index: int, literal_beams: int) -> None:
        super().__init__(seed, index, literal_beams)
        plan = manual_plan(self.world, self.setup)
        off = dict.fromkeys(("motion", "leakage", "spurs", "iq_imbalance"), False)
        self._signal = plan.paths, msgspec.structs.replace(plan.signal, **off)
        # evenly over the scan
        share = np.linspace(0.0, 1.0, literal_beams + 2)[1:-1]
        self._beams = np.unique((share * (len(self.setup.beams) - 1)).round().astype(int))

    def answer(self, value: Value, clock: Clock) -> np.ndarray:
        """Profiles of the literal level's beams; time is that of a scan, one chirp a beam."""
        job = (self.setup, *self._signal, self.front_end)
        if value == "literal":
            with clock.part("signal", len(self._beams) / len(self.setup.beams)):
                return literal_profiles(*job, self._beams.tolist())
        with clock.part("signal"):
            if value == "beat":
                profiles = hann_profiles(beam_beats(*job), self.setup.radar.samples_per_chirp)
            else:
                profiles = kernel_profiles(*job, precision=str(value).removeprefix("kernel "))
        return profiles[self._beams]

    def truth(self, answers: dict[Value, Any]) -> np.ndarray:
        """The literal level."""
        reference = answers.get("literal")
        return self.answer("literal", Clock()) if reference is None else reference

    def errors(self, answer: np.ndarray, truth: np.ndarray) -> dict[str, float]:
        """The law's ratio in the cells of these beams."""
        return _cell_errors(np.abs(answer - truth) / self.cells.floor(self.everything, self.rms)[self._beams])


class _Planned(_Place):
    """Effects under a budget, as `sim effects` shows them."""

    def answer(self, value: Value, clock: Clock) -> np.ndarray:
        """Profiles with noise; aside, the beats of the scan."""
        if value == "basic":
            return self._basic(clock)
        with clock.part("paths"):
            if isinstance(value, str):
                plan = manual_plan(self.world, self.setup, ALL_EFFECTS if value == "all" else value.split(","))
            else:
                plan = plan_world(self.world, self.setup, value, profiles_only=True)
        with clock.part("signal"):
            clean = clean_profiles(plan, self.setup, self.index)
        with clock.aside("beats"):
            plan.beats()
        return clean + noise_profiles(self.setup, self.index, plan.signal, self.front_end)

    def _basic(self, clock: Clock) -> np.ndarray:
        """Direct echoes and single mirrors, the plain signal chain, no faults."""
        with clock.part("paths"):
            paths = trace(self.world)
        with clock.part("signal"):
            clean = kernel_profiles(self.setup, paths, precision="float32")
        with clock.aside("beats"):
            beam_beats(self.setup, paths)
        return clean + noise_profiles(self.setup, self.index, PLAIN)


class _Without(_Place):
    """All effects but some."""

    def answer(self, value: Value, clock: Clock) -> np.ndarray:
        """Profiles with noise."""
        dropped = frozenset() if value == "all" else check_effects(frozenset(str(value).split("+")))
        with clock.part("paths"):
            plan = manual_plan(self.world, self.setup, ALL_EFFECTS - dropped)
        with clock.part("signal"):
            clean = clean_profiles(plan, self.setup, self.index)
        return clean + noise_profiles(self.setup, self.index, plan.signal, self.front_end)


class _Body:
    """A metal body seen from drawn directions at 10 GHz, through rays that bounce."""

    once: frozenset[Value] = frozenset()

    def __init__(self, seed: int, index: int) -> None:
        self.name, size_m = BODIES[index]
        self._mesh = primitive_mesh(self.name, size_m, "metal")
        # from any side, up to 15 deg over the body
        rng = np.random.default_rng([seed, index, 2])
        azimuth, elevation = rng.uniform(-np.pi, np.pi, DIRECTIONS), rng.uniform(0.0, np.pi / 12.0, DIRECTIONS)
        level = np.cos(elevation)
        self._directions = np.column_stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])

    def answer(self, value: Value, clock: Clock) -> np.ndarray:
        """Fields, square root of RCS; complex128 [directions]."""
        with clock.part("rays"):
            spacing_m = WAVELENGTH_M / float(value)
            fields = [
                mesh_field(self._mesh, direction, WAVELENGTH_M, ray_spacing_m=spacing_m)
                for direction in self._directions
            ]
        return np.array(fields)

    def truth(self, answers: dict[Value, Any]) -> np.ndarray:
        """The densest rays."""
        return self.answer(MAX_RAYS, Clock())

    def errors(self, answer: np.ndarray, truth: np.ndarray) -> dict[str, float]:
        """Largest difference of the fields as a share of the strongest."""
        return {"field": float(np.abs(answer - truth).max() / np.abs(truth).max())}


class _Wall:
    """A smooth wall by time stepping."""

    once: frozenset[Value] = frozenset()

    def __init__(self, index: int) -> None:
        self._wall = wall = SMOOTH_WALLS[index]
        self.name = f"{wall.name} {wall.frequency_hz / 1e9:g} GHz {wall.polarisation.upper()}"

    def answer(self, value: Value, clock: Clock) -> np.ndarray:
        """Reflection at all angles, complex128 [angles]."""
        with clock.part("fdtd"):
            runs = self._wall.simulated(np.radians(ANGLES_DEG), float(value), workers=1)
        return np.array([run.r for run in runs])

    def truth(self, answers: dict[Value, Any]) -> np.ndarray:
        """The exact slab."""
        return self._wall.exact(np.radians(ANGLES_DEG))

    def errors(self, answer: np.ndarray, truth: np.ndarray) -> dict[str, float]:
        """Largest error of the complex r over the angles."""
        return {"r": float(np.abs(answer - truth).max())}


@dataclass(frozen=True)
class Group:
    """One choice: its settings, and what they are tried on, timed and measured against."""

    settings: tuple[Value, ...]
    #: Of a seed, an index, and the beams that the literal level runs.
    case: Callable[[int, int, int], Case]
    #: How a number of its settings is called.
    unit: str
    about: str


_LAW = (
    "|difference| / max(noise rms, strongest within one range bin and half a beam) [dB] in the worst and in the median "
    "cell of a place"
)
GROUPS: dict[str, Group] = {
    "signal level": Group(
        ("kernel float32", "kernel float64", "beat", "literal"),
        _Levels,
        "",
        f"Echoes of all effects against the literal level: {_LAW}, over the beams that the literal level ran; "
        "time of a scan, the literal level's scaled to it.",
    ),
    "effect budget": Group(
        ("basic", *reversed(BUDGETS_DB), "all"),
        _Planned,
        "dB",
        f"Effects planned under a budget, for samples, against all effects: {_LAW}; time of paths, planning and "
        "signal at the kernel level, and beside it that of a scan's beats.",
    ),
    "all but": Group(
        ("all", MIRRORS, *PATHS, *WEIGHTS, *ANTENNA_AND_SWEEP),
        _Without,
        "",
        f"One effect left out of all, and every mirror: {_LAW}.",
    ),
    "rays": Group(
        (2.0, 4.0, 8.0, 16.0, 32.0),
        lambda seed, index, _: _Body(seed, index),
        "rays a wavelength",
        f"Field of a metal body from {DIRECTIONS} directions at 10 GHz against {MAX_RAYS:g} rays a wavelength: "
        "largest difference as a share of the strongest.",
    ),
    "fdtd": Group(
        (5.0, 10.0, 20.0, 40.0, 80.0),
        lambda _, index, __: _Wall(index),
        "cells a wavelength",
        "Reflection of smooth walls at 10 and 77 GHz, TE and TM, against the exact slab: largest error of the "
        "complex r over 0..80 deg by 5; time of all 17 angles.",
    ),
}


def setting_name(group: str, value: Value) -> str:
    """Return the name of a setting in its group."""
    return value if isinstance(value, str) else f"{value:g} {GROUPS[group].unit}".strip()
