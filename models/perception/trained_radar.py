"""The radar that a network was trained for: maps of others are flagged, not refused, for many are read well."""

from __future__ import annotations

import msgspec
import numpy as np

from msgs.values.radar import BeamGrid, RadarSetup, RangeAzimuthGrid

#: Relative differences of carrier and column spacing that count as the same: echoes and lobes hardly change.
CARRIER_TOLERANCE, SPACING_TOLERANCE = 0.2, 0.1


class TrainedRadar(msgspec.Struct, frozen=True, kw_only=True):
    """Carrier, array and beams of the maps in training; travels in the network's card. Defaults: the 10 GHz preset."""

    carrier_hz: float = 10e9
    columns: int = 8
    #: Spacing of the columns in wavelengths.
    column_spacing: float = 0.5
    steered_ways: int = 2
    phase_bits: int = 6
    azimuth_deg: tuple[float, ...] = BeamGrid().azimuth_deg

    @classmethod
    def of(cls, setup: RadarSetup) -> TrainedRadar:
        """Return that of a data set's set-up."""
        array, wavelength_m = setup.array, setup.radar.wavelength_m
        return cls(
            carrier_hz=setup.radar.carrier_hz,
            columns=array.columns,
            column_spacing=array.column_spacing(wavelength_m) / wavelength_m,
            steered_ways=array.steered_ways,
            phase_bits=array.phase_bits,
            azimuth_deg=setup.beams.azimuth_deg,
        )

    def differences(self, setup: RadarSetup, unused_beams: tuple[int, ...] = ()) -> list[str]:
        """Return the fields in which a set-up differs from training; beams may be more or fewer within their largest
        step.
        """
        own = TrainedRadar.of(setup)
        tolerances = {
            "carrier_hz": CARRIER_TOLERANCE, "columns": 0.0, "column_spacing": SPACING_TOLERANCE, "steered_ways": 0.0
        }  # fmt: skip
        different = [
            f"{name} {getattr(own, name):g} in place of {getattr(self, name):g}"
            for name, tolerance in tolerances.items()
            if abs(getattr(own, name) / getattr(self, name) - 1.0) > tolerance
        ]
        # two bits serve as well as six; with one every beam looks to both sides
        if own.phase_bits == 1 != self.phase_bits:
            different.append(f"phase_bits 1 in place of {self.phase_bits}")
        trained_deg = np.sort(self.azimuth_deg)
        looked_deg = np.delete(np.asarray(own.azimuth_deg), list(unused_beams))
        step_deg = float(np.diff(trained_deg).max(initial=0.0))
        away_deg = np.abs(trained_deg[:, None] - looked_deg).min(axis=1, initial=np.inf)
        if blind := int((away_deg > step_deg + 1e-6).sum()):
            different.append(f"no beam within {step_deg:g} deg of {blind} of {len(trained_deg)} directions")
        return different


class SetupCheck:
    """Comparison of a radar in use with the one that a network was trained for."""

    def __init__(self, network: str, trained: TrainedRadar, setup: RadarSetup) -> None:
        self._network, self._trained, self._setup = network, trained, setup
        self._doubts: dict[tuple[int, ...], str] = {}

    def doubt(self, unused_beams: tuple[int, ...] = ()) -> str:
        """Return one line on what is different where some beams are not asked for; empty: nothing."""
        if unused_beams not in self._doubts:
            what = ", ".join(self._trained.differences(self._setup, unused_beams))
            line = f"{self._network} was trained for another radar: {what}; profile cfar needs no network"
            self._doubts[unused_beams] = line if what else ""
        return self._doubts[unused_beams]


def require_grid(network: str, trained: RangeAzimuthGrid, grid: RangeAzimuthGrid) -> None:
    """Raise `ValueError` naming the first field in which the grid of a map is not the one in training."""
    for name in trained.__struct_fields__:
        wanted, got = getattr(trained, name), getattr(grid, name)
        if wanted != got:
            of = " (c over twice the bandwidth)" if name == "range_bin_m" else ""
            raise ValueError(
                f"map.grid.{name}{of} must be {wanted:.7g}, as {network} was trained, got {got:.7g}; "
                "profile cfar needs no network"
            )
