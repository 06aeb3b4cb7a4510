"""The sensors that are compared: one way each from a scene to a map on the common grid, its noise law, its prediction.

A map's noise decides what counts as seen: the threshold of a cell is passed by noise alone with `FALSE_ALARM`, by the
law of its sensor (exponential power of a radar, Poisson counts of photons). What a point looks like in a map, beam
and side lobes, is the sensor's own; all else is common.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, Protocol, cast, get_args

import msgspec
import numpy as np
from scipy.stats import poisson

from lab.compare.comparison_scenes import MirrorPath, with_sensor
from lab.compare.detection_snr import photon_snr, radar_snr, radar_threshold
from models.perception.find.peaks import PeakParams
from models.perception.find.ridges import RidgeParams
from models.perception.form.coarray import AzimuthInterpolator
from models.perception.form.photon_map import photon_map, project_counts
from models.perception.form.ra_forming import ScanProfiles, form_map
from models.physics.photons.counting import expected_histogram
from models.physics.photons.optics import (
    OBJECT_ALBEDO,
    confocal_photons,
    diffuse_reflectance,
    direct_photons,
    optical_material,
    optical_reflectance,
)
from msgs.values.lidar import SpadParams
from msgs.values.radar import RadarSetup, RangeAzimuthGrid, RangeAzimuthMap
from msgs.values.units import SPEED_OF_LIGHT_MPS, ratio_from_db
from sim_player.dataset.labelled_scan import clean_profiles, noise_power_mw, profile_noise
from sim_player.lidar.player import LidarPlayer
from sim_player.paths.ray_tracing import trace
from sim_player.scene.description import PRESETS, Scene
from sim_player.scene.world import prepare

#: Probability that noise alone passes the threshold of a cell: one false alarm in eight maps of 131 072 cells.
FALSE_ALARM = 1e-6
#: Equal transmit power, each sensor with its own measuring time; or equal energy of a scan as well.
Equal = Literal["power", "energy"]


def equal_of(word: str) -> Equal:
    """Check the quantities that are to be equal; ValueError for anything else."""
    for measure in get_args(Equal):
        if word == measure:
            return cast(Equal, measure)
    raise ValueError(f"--equal must be one of {', '.join(get_args(Equal))}, got {word!r}")


GRID = RangeAzimuthGrid()
#: No point of a LiDAR has side lobes.
NO_LOBES_DB = 1e3
#: The long period reaches as far as the grid, in gates of 5 m: the wall's own return then shares none with most images.
LONG_RANGE_M, LONG_GATES = 110.0, 22
#: Gates of Table 2's period: shorter than the way from a wall to what stands in front of it.
SHORT_GATES = 8


@dataclass(frozen=True)
class Sight:
    """A map, what |values|^2 must exceed to count as seen (broadcasts to the map), and a point's look."""

    ra_map: RangeAzimuthMap
    threshold: np.ndarray
    ridges: RidgeParams
    peaks: PeakParams


class Sensor(Protocol):
    """One modality."""

    @property
    def name(self) -> str:
        """As options and files say it."""

    @property
    def title(self) -> str:
        """For people."""

    @property
    def wavelength_m(self) -> float:
        """In air."""

    def look(self, scene: Scene, seed: int, noise_seed: int, equal: Equal) -> Sight:
        """One scan of a scene at rest; `seed` draws the scene's scatterers, `noise_seed` the noise."""

    def predicted_snr(self, scene: Scene, mirror: MirrorPath, equal: Equal) -> float:
        """Closed form of the strongest cell over the mean noise, of the first object behind the first surface."""

    def energy_j(self, equal: Equal) -> float:
        """Energy sent in one scan."""


@dataclass(frozen=True)
class RadarSensor:
    """An FMCW radar by its preset."""

    name: str
    title: str

    @property
    def wavelength_m(self) -> float:
        """Of the carrier."""
        return PRESETS[self.name].radar.wavelength_m

    def setup(self, height_m: float, equal: Equal) -> RadarSetup:
        """The preset at a height; of equal energy with as many more chirps as X-band sends in a scan."""
        setup = msgspec.structs.replace(PRESETS[self.name], radar_height_m=height_m)
        if equal == "power":
            return setup
        chirps = round(setup.radar.chirps_per_beam * scan_energy_j(PRESETS["xband"]) / scan_energy_j(setup))
        return msgspec.structs.replace(setup, radar=msgspec.structs.replace(setup.radar, chirps_per_beam=chirps))

    def look(self, scene: Scene, seed: int, noise_seed: int, equal: Equal) -> Sight:
        """Kernel level, basic effects, thermal noise, the map as on the vehicle."""
        scene = with_sensor(scene, self.name)
        setup = self.setup(scene.radar.height_m, equal)
        profiles = clean_profiles(setup, trace(prepare(scene, seed, setup))) + profile_noise(setup, noise_seed)
        interpolator, share = _interpolator(self.name)
        noise_mw, stamps_ns = noise_power_mw(setup), np.zeros(len(profiles), np.int64)
        ra_map = form_map(ScanProfiles(0, 0, profiles.astype(np.complex64), noise_mw, stamps_ns, ()), interpolator)
        threshold = float(radar_threshold(FALSE_ALARM)) * noise_mw * share
        return Sight(ra_map, threshold, *_radar_look(setup))

    def predicted_snr(self, scene: Scene, mirror: MirrorPath, equal: Equal) -> float:
        """Radar equation for a point of the class's mean RCS behind a wall's coherent reflection."""
        scene = with_sensor(scene, self.name)
        setup = self.setup(scene.radar.height_m, equal)
        world = prepare(scene, 0, setup)
        whole, _, rough = world.reflection(np.array([0]), np.array([mirror.cos_incidence]))
        rcs_m2 = ratio_from_db(scene.objects[0].kind.mean_rcs_dbsm)
        wall = float(np.abs(whole[0] * rough[0]) ** 2)
        return float(radar_snr(setup, mirror.range_m, rcs_m2, min(wall, 1.0), mirror.azimuth_rad))

    def energy_j(self, equal: Equal) -> float:
        """Transmit power times the time of all beams."""
        return scan_energy_j(self.setup(1.0, equal))


def scan_energy_j(setup: RadarSetup) -> float:
    """Energy that a radar sends in one scan: of a digital array one beam's time for all."""
    beams = 1 if setup.array.digital else len(setup.beams)
    return setup.radar.transmit_power_w * setup.radar.beam_duration_s * beams


@lru_cache(maxsize=4)
def _interpolator(preset: str) -> tuple[AzimuthInterpolator, np.ndarray]:
    """Return the interpolator from a preset's beams to a map, and the noise of each azimuth relative to a beam's."""
    interpolator = AzimuthInterpolator(PRESETS[preset], GRID)
    share = np.sum(np.abs(interpolator.coherent_matrix) ** 2, axis=0)
    return interpolator, share.astype(np.float64)


def _radar_look(setup: RadarSetup) -> tuple[RidgeParams, PeakParams]:
    """Beam and side lobes of an untapered array: 0.886 lambda / D and -13.3 dB one way, squared both ways."""
    steered_rad, columns = setup.array.steered_ways, setup.array.columns
    width_deg = math.degrees(0.886 * 2.0 / columns) / math.sqrt(steered_rad)
    cells = round(width_deg / math.degrees(GRID.azimuth_step_rad))
    ridges = RidgeParams(spacing=(2, 4), min_snr_db=0.0, azimuth_lobe_db=11.0 * steered_rad, beam_cells=cells)
    return ridges, _peak_params(width_deg)


def _peak_params(width_deg: float) -> PeakParams:
    """Errors of a peak of a beam, in the proportions of the X-band radar's; a cell's own width at least."""
    default, step_deg = PeakParams(), math.degrees(GRID.azimuth_step_rad)
    scale = width_deg / default.beam_width_deg
    floor_deg = max(scale * default.azimuth_std_floor_deg, step_deg / math.sqrt(12.0))
    limit_deg = max(scale * default.azimuth_std_limit_deg, floor_deg)
    return PeakParams(beam_width_deg=width_deg, azimuth_std_floor_deg=floor_deg, azimuth_std_limit_deg=limit_deg)


@dataclass(frozen=True)
class SpadSensor:
    """A single-photon LiDAR: parameters at equal power."""

    name: str
    title: str
    spad: SpadParams

    @property
    def wavelength_m(self) -> float:
        """Of the laser."""
        return self.spad.wavelength_m

    def params(self, equal: Equal) -> SpadParams:
        """Parameters; of equal energy with the X-band scan's, shared out over all azimuths."""
        if equal == "power":
            return self.spad
        time_s = scan_energy_j(PRESETS["xband"]) / self.spad.average_power_w / GRID.azimuth_bins
        return msgspec.structs.replace(self.spad, measurement_time_s=time_s)

    def look(self, scene: Scene, seed: int, noise_seed: int, equal: Equal) -> Sight:
        """One scan as the player gives it."""
        player = LidarPlayer(with_sensor(scene, "spad", self.params(equal)), noise_seed)
        ra_map = photon_map(player.setup, player.scan(0))
        threshold = count_threshold(player.setup.spad)[:, None]
        ridges = RidgeParams(
            spacing=(2, 4), min_snr_db=0.0, azimuth_lobe_db=NO_LOBES_DB, range_lobe_db=NO_LOBES_DB, beam_cells=1
        )
        width_deg = math.degrees(self.spad.divergence_rad)
        return Sight(ra_map, threshold, ridges, _peak_params(width_deg))

    def predicted_snr(self, scene: Scene, mirror: MirrorPath, equal: Equal) -> float:
        """Photons by the wall's mirror and by its matt face, behind the wall's own return where one gate holds both."""
        spad, wall, target = self.params(equal), scene.surfaces[0], scene.objects[0]
        material, albedo = optical_material(wall.material), OBJECT_ALBEDO.get(target.object_class, 0.4)
        face = mirror.cos_incidence, 1e-3 * wall.roughness_mm, spad.wavelength_m
        specular = float(optical_reflectance(material.index, *face))
        matt = float(diffuse_reflectance(material.index, material.albedo, *face))
        # an upright side as tall as the object, one cell deep at the wall's slant
        area_m2 = target.kind.height_m * GRID.range_bin_m / max(math.sqrt(1.0 - mirror.cos_incidence**2), 0.1)
        photons = specular**2 * direct_photons(spad, mirror.range_m, albedo, mirror.cos_incidence)
        photons += confocal_photons(
            spad, mirror.to_wall_m, matt, mirror.beyond_m, mirror.cos_incidence, mirror.cos_incidence, area_m2, albedo
        )
        earlier = direct_photons(spad, mirror.to_wall_m, matt, mirror.cos_incidence)
        return float(photon_snr(spad, mirror.range_m, photons, earlier, mirror.to_wall_m))

    def energy_j(self, equal: Equal) -> float:
        """Mean power times the time of all azimuths."""
        spad = self.params(equal)
        return spad.average_power_w * spad.measurement_time_s * GRID.azimuth_bins


@lru_cache(maxsize=8)
def count_threshold(spad: SpadParams) -> np.ndarray:
    """Squared deviation [range] that ambient counts alone exceed with `FALSE_ALARM`; infinite beyond the period.

    A Poisson quantile of each cell's expected counts: where these are few, their tail reaches well beyond a normal one.
    """
    empty = np.zeros(0)
    histogram = np.broadcast_to(expected_histogram(spad, empty, empty), (GRID.azimuth_bins, spad.bins))
    counts = project_counts(histogram, spad, GRID)[:, 0]
    deviation = (poisson.isf(FALSE_ALARM, counts) + 0.5 - counts) / np.sqrt(np.maximum(counts, 1.0))
    return np.where(counts > 0.0, np.square(deviation), np.inf)


def long_period(spad: SpadParams) -> SpadParams:
    """The period lengthened to reach beyond the grid at equal average power: fewer, stronger pulses, in gates.

    Each of whole bins, a few more than before: counts of a bin across a border would not say whose they are.
    """
    rate_hz, bins = 0.5 * SPEED_OF_LIGHT_MPS / LONG_RANGE_M, LONG_GATES * math.ceil(spad.bins / LONG_GATES)
    return msgspec.structs.replace(spad, repetition_rate_hz=rate_hz, bins=bins, arming="gated", gates=LONG_GATES)


TABLE_2 = SpadParams()
RADARS = {
    sensor.name: sensor for sensor in (RadarSensor("xband", "X-band radar"), RadarSensor("77ghz", "77 GHz radar"))
}
LIDARS = {
    sensor.name: sensor
    for sensor in (
        SpadSensor("spad", "SPAD, Table 2", TABLE_2),
        SpadSensor(
            "spad_gated",
            "SPAD, Table 2 gated",
            msgspec.structs.replace(TABLE_2, arming="gated", gates=SHORT_GATES),
        ),
        SpadSensor("spad_long", "SPAD, long period", long_period(TABLE_2)),
    )
}
SENSORS: dict[str, Sensor] = {**RADARS, **LIDARS}
