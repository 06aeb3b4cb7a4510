"""Physics anchors: what the simulator says where a textbook knows the answer.

Run from the root of the checkout: python -m benchmarks.simulator.physics_anchors [--json]
The tests in tests/lab/full_wave/test_shot_rays.py assert the same anchors.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial

import numpy as np
from scipy.optimize import brentq

from models.physics.antenna import setup_weights, two_way_pattern
from models.physics.waveform import range_profile, window_noise_gain
from msgs.values.radar import PRESETS, RadarSetup, amplitude_per_code
from msgs.values.units import SPEED_OF_LIGHT_MPS
from sim_player.bodies.meshes import primitive_mesh
from sim_player.dataset.labelled_scan import WINDOW, profile_noise
from sim_player.paths.ray_tracing import trace
from sim_player.scene.description import Scene, SceneObject, SceneRadar
from sim_player.scene.world import prepare
from sim_player.signal.fmcw import beam_codes, noise_bank, noise_reads
from sim_player.trace.echoes import echo_amplitude

CARRIERS_HZ = (10e9, 77e9)
#: Distance of the targets in scenes, and the height of their middles and of the radar.
FAR_M, HIGH_M = 100.0, 2.0
#: Boltzmann's constant (SI, exact) and the reference temperature, written out: an anchor shares no constant.
BOLTZMANN, TEMPERATURE_K = 1.380649e-23, 290.0


def scene_rcs_m2(carrier_hz: float, primitive: str, size_m: tuple[float, ...]) -> float:
    """RCS [m^2] of a primitive in a scene, from its traced amplitude by the radar equation.

    It stands `FAR_M` ahead at the radar's height and faces it. Bias: a face of 20 wavelengths at 10 GHz is 0.04 dB
    weaker than far away, and a corner stands 0.3 m behind or before its box's middle, 0.05 dB.
    """
    height_m = float(primitive_mesh(primitive, size_m).extent_m[2])
    target = SceneObject(
        primitive=primitive, size_m=size_m, x_m=FAR_M, y_m=0.0, yaw_deg=180.0, z_m=HIGH_M - 0.5 * height_m
    )
    preset = next(name for name, setup in PRESETS.items() if setup.radar.carrier_hz == carrier_hz)
    radar = SceneRadar(preset=preset, height_m=HIGH_M)
    world = prepare(Scene(name="anchor", radar=radar, objects=(target,)))
    paths = trace(world, 0.0, frozenset({"los_objects"}))
    wavelength_m = world.radar.wavelength_m
    field = (paths.amplitude * np.exp(-2j * np.pi / wavelength_m * paths.length_m)).sum()
    power_mw = 1e3 * world.radar.transmit_power_w
    return float(abs(field) ** 2 * (4.0 * math.pi) ** 3 * FAR_M**4 / (power_mw * wavelength_m**2))


@dataclass(frozen=True)
class Anchor:
    """One figure beside the textbook's, both in `unit`; it holds where they differ by no more than `tolerance`."""

    name: str
    measured: float
    expected: float
    unit: str
    tolerance: float
    note: str = ""

    @property
    def error(self) -> float:
        """Measured minus expected."""
        return self.measured - self.expected

    @property
    def holds(self) -> bool:
        """Whether it is within the tolerance."""
        return abs(self.error) <= self.tolerance


def plate_rcs(carrier_hz: float, edge: float = 10.0) -> Anchor:
    """Square plate of `edge` wavelengths head on: 4 pi A^2 / lambda^2."""
    wavelength_m = SPEED_OF_LIGHT_MPS / carrier_hz
    side_m = edge * wavelength_m
    measured = scene_rcs_m2(carrier_hz, "plate", (side_m, side_m))
    expected = 4.0 * math.pi * side_m**4 / wavelength_m**2
    return _rcs_anchor(f"plate {edge:g} lambda", carrier_hz, measured, expected, 0.2)


def dihedral_rcs(carrier_hz: float, edge: float = 10.0) -> Anchor:
    """Dihedral of two square plates along its bisector: 8 pi a^2 b^2 / lambda^2, vertical polarisation."""
    wavelength_m = SPEED_OF_LIGHT_MPS / carrier_hz
    side_m = edge * wavelength_m
    measured = scene_rcs_m2(carrier_hz, "dihedral", (side_m, side_m))
    expected = 8.0 * math.pi * side_m**4 / wavelength_m**2
    note = "the plates' own side lobes add to the double bounce"
    return _rcs_anchor(f"dihedral {edge:g} lambda", carrier_hz, measured, expected, 0.2, note)


def trihedral_rcs(carrier_hz: float, edge: float = 20.0) -> Anchor:
    """Triangular trihedral along its axis: 4 pi a^4 / (3 lambda^2), which counts triple bounces alone."""
    wavelength_m = SPEED_OF_LIGHT_MPS / carrier_hz
    edge_m = edge * wavelength_m
    measured = scene_rcs_m2(carrier_hz, "trihedral", (edge_m,))
    expected = 4.0 * math.pi * edge_m**4 / (3.0 * wavelength_m**2)
    note = "single and double bounces add to the triple one"
    return _rcs_anchor(f"trihedral {edge:g} lambda", carrier_hz, measured, expected, 0.5, note)


def sphere_rcs(carrier_hz: float, radius: float = 10.0) -> Anchor:
    """Sphere against geometric optics, pi a^2; its nearest point is 0.3 m nearer than its middle at 10 GHz."""
    radius_m = radius * SPEED_OF_LIGHT_MPS / carrier_hz
    measured = scene_rcs_m2(carrier_hz, "sphere", (2.0 * radius_m,))
    return _rcs_anchor(f"sphere a = {radius:g} lambda", carrier_hz, measured, math.pi * radius_m**2, 0.1)


def cylinder_rcs(carrier_hz: float, radius: float = 10.0) -> Anchor:
    """Upright cylinder from its side: k a h^2; the height is its diameter."""
    wavelength_m = SPEED_OF_LIGHT_MPS / carrier_hz
    radius_m = radius * wavelength_m
    measured = scene_rcs_m2(carrier_hz, "cylinder", (2.0 * radius_m, 2.0 * radius_m))
    expected = 2.0 * math.pi / wavelength_m * radius_m * (2.0 * radius_m) ** 2
    return _rcs_anchor(f"cylinder a = {radius:g} lambda", carrier_hz, measured, expected, 0.1)


def radar_equation(preset: str, range_m: float, rcs_m2: float = 10.0) -> Anchor:
    """Peak of a point's range profile in the beam at 0 deg against P G_t G_r lambda^2 sigma / ((4 pi)^3 R^4)."""
    setup = PRESETS[preset]
    radar, array = setup.radar, setup.array
    # the middle of a range bin: no scalloping
    bin_index = round(range_m / radar.range_bin_m)
    range_m = bin_index * radar.range_bin_m
    gain = two_way_pattern(setup, _boresight(setup), np.zeros(1), np.zeros(1))[0, 0]
    amplitude = echo_amplitude(radar, np.array([rcs_m2]), np.array([range_m]))[0]
    profile = range_profile(radar, np.array([2.0 * range_m]), 512, WINDOW)[0]
    measured_mw = float(np.abs(amplitude * gain * profile).max() ** 2)
    element = 10.0 ** (setup.element.peak_gain_dbi / 10.0)
    receive = array.columns * array.rows * element
    transmit = receive if array.steered_ways == 2 else element
    wavelength_m = SPEED_OF_LIGHT_MPS / radar.carrier_hz
    expected_mw = 1e3 * radar.transmit_power_w * transmit * receive * wavelength_m**2 * rcs_m2
    expected_mw /= (4.0 * math.pi) ** 3 * range_m**4
    name = f"radar equation {preset} {range_m:.1f} m"
    return Anchor(name, _db(measured_mw), _db(expected_mw), "dBm", 0.01, f"{rcs_m2:g} m^2")


def beat_noise_floor(preset: str, seed: int = 0) -> Anchor:
    """Mean power of a beam's int16 codes with nothing in front: k T0 f_s F over the sampled band."""
    setup = PRESETS[preset]
    radar = setup.radar
    nothing = np.zeros((1, radar.samples_per_chirp), np.complex128)
    chirps = np.ones(radar.chirps_per_beam)
    noise = noise_reads(radar, noise_bank(radar, seed), [seed, 0])
    codes = beam_codes(setup, nothing, chirps + 0j, chirps[None], noise)
    per_code_mw = amplitude_per_code(setup.full_scale_dbm) ** 2
    measured_mw = 2.0 * float(np.mean(np.square(codes, dtype=np.float64))) * per_code_mw
    return Anchor(f"noise floor of beats {preset}", _db(measured_mw), _db(_thermal_mw(setup)), "dBm", 0.1)


def profile_noise_floor(preset: str, scans: int = 4) -> Anchor:
    """Mean power of the noise of range profiles: k T0 f_s F over samples and chirps, times the window's 1.5."""
    setup = PRESETS[preset]
    radar = setup.radar
    measured_mw = np.mean([np.mean(np.abs(profile_noise(setup, seed)) ** 2) for seed in range(scans)])
    cells = radar.samples_per_chirp * radar.chirps_per_beam
    expected_mw = _thermal_mw(setup) * window_noise_gain(WINDOW) / cells
    return Anchor(f"noise floor of profiles {preset}", _db(float(measured_mw)), _db(expected_mw), "dBm", 0.1)


def beam_width(preset: str, two_way: bool) -> Anchor:
    """Half-power width of the beam at 0 deg in degrees against a filled aperture of N d.

    One way 0.886 lambda / (N d), two way the half-power points of sinc^4, both exact in the sine of the angle. Bias:
    columns are points (the width of 8 is 0.3 % off the sinc's) and the element pattern narrows the beam a little.
    """
    setup = PRESETS[preset]
    wavelength_m = setup.radar.wavelength_m
    aperture_m = setup.array.columns * setup.array.column_spacing(wavelength_m)
    level = 0.5 if two_way else 0.25
    # of a pattern that is squared where both ways are steered
    measured_level = 0.5 if setup.array.steered_ways == 1 else level
    weights = _boresight(setup)

    def over_half(azimuth_rad: float) -> float:
        """Power relative to the beam's middle, less the level; one-way half power is a quarter two-way."""
        power = np.abs(two_way_pattern(setup, weights, np.array([0.0, azimuth_rad]), np.zeros(2))[0]) ** 2
        return float(power[1] / power[0] - measured_level)

    half_rad = brentq(over_half, 0.0, wavelength_m / aperture_m)
    theory = brentq(lambda x: np.sinc(x) ** 4 - level, 0.0, 1.0)
    expected_deg = 2.0 * math.degrees(math.asin(theory * wavelength_m / aperture_m))
    name = f"{'two' if two_way else 'one'}-way beam width, {setup.array.columns} columns"
    tolerance_deg = 0.015 * expected_deg
    return Anchor(
        name, 2.0 * math.degrees(half_rad), expected_deg, "deg", tolerance_deg, f"{theory * 2:.3f} lambda/(N d)"
    )


def _all() -> Iterator[Callable[[], Anchor]]:
    """Every anchor, not yet computed; RCS first."""
    for carrier_hz in CARRIERS_HZ:
        # scenes hold nothing under 5 cm
        larger = 3.0 if carrier_hz > 50e9 else 1.0
        yield from (partial(plate_rcs, carrier_hz, larger * edge) for edge in (5.0, 10.0, 20.0))
        yield from (partial(dihedral_rcs, carrier_hz, larger * edge) for edge in (5.0, 10.0, 20.0))
        yield from (partial(trihedral_rcs, carrier_hz, larger * edge) for edge in (10.0, 15.0, 20.0, 30.0))
        yield partial(sphere_rcs, carrier_hz)
        yield partial(cylinder_rcs, carrier_hz)
    for preset in PRESETS:
        yield from (partial(radar_equation, preset, range_m) for range_m in (5.0, 10.0, 20.0, 50.0, 100.0))
        yield partial(beat_noise_floor, preset)
        yield partial(profile_noise_floor, preset)
        ways = (False, True)[: PRESETS[preset].array.steered_ways]
        yield from (partial(beam_width, preset, two_way) for two_way in ways)


ANCHORS = tuple(_all())


def main() -> int:
    """Print all anchors; 1 where one does not hold."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON array")
    options = parser.parse_args()
    found = [anchor() for anchor in ANCHORS]
    if options.json:
        print(json.dumps([asdict(anchor) | {"error": anchor.error, "holds": anchor.holds} for anchor in found]))
    else:
        for anchor in found:
            print(_line(anchor))
    return 0 if all(anchor.holds for anchor in found) else 1


def _rcs_anchor(
    name: str, carrier_hz: float, measured_m2: float, expected_m2: float, tolerance_db: float, note: str = ""
) -> Anchor:
    """An RCS in dBsm."""
    return Anchor(f"{name} {carrier_hz / 1e9:g} GHz", _db(measured_m2), _db(expected_m2), "dBsm", tolerance_db, note)


def _line(anchor: Anchor) -> str:
    """One row of the table."""
    figures = f"{anchor.measured:11.4f} {anchor.expected:11.4f} {anchor.unit:4} {anchor.error:+9.4f}"
    verdict = "holds" if anchor.holds else "FAILS"
    return f"{anchor.name:38}{figures} of {anchor.tolerance:.3f}  {verdict}  {anchor.note}".rstrip()


def _thermal_mw(setup: RadarSetup) -> float:
    """k T0 f_s F in milliwatt."""
    figure = 10.0 ** (setup.radar.noise_figure_db / 10.0)
    return 1e3 * BOLTZMANN * TEMPERATURE_K * setup.radar.sample_rate_hz * figure


def _boresight(setup: RadarSetup) -> np.ndarray:
    """Weights of the beam nearest 0 deg, [1, columns]."""
    return setup_weights(setup)[[int(np.argmin(np.abs(setup.beams.azimuth_rad)))]]


def _db(power: float) -> float:
    return 10.0 * math.log10(power)


if __name__ == "__main__":
    sys.exit(main())
