"""The real burst beside its simulated twin, where it is at hand; and a receiver of known faults, always."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from benchmarks.simulator.real_burst import FAULTS, SCENE, compare, draw, measured, played, setup
from contrib.calibrate.radar_alone import scene_with_receiver
from sim_player.scene.description import load_scene, scene_from_yaml, scene_to_yaml
from sim_player.scene.front_end import FrontEnd, Spur
from tests.captures import DATA, needs

BURST = DATA / "xband_cn0566_fmcw"


@needs(BURST)
@pytest.mark.slow
def test_the_real_burst_and_its_twin(tmp_path: Path) -> None:
    """The burst's note: strongest at 6.5 m, leakage at 1.2 m and 3.3 dB below, ridges at +-250 Hz. Tolerance: one range
    bin, 2 dB for a Hann window between bins, one Doppler bin. The twin has the receiver's own faults, within what the
    model of white and 1/f noise leaves (4 dB), and not the ridges and the pedestal, which the simulator has not."""
    rows, real, twin = compare(DATA, 0)
    note, copy = rows["real"], rows["simulated"]
    assert note["strongest_m"] == pytest.approx(6.5, abs=0.36)
    assert note["leakage"]["range_m"] == pytest.approx(1.2, abs=0.36)
    assert note["leakage"]["level_db"] == pytest.approx(-3.3, abs=2.0)
    ((ridge_hz, ridge_db),) = note["sidebands"]
    assert ridge_hz == pytest.approx(250.0, abs=62.5)
    assert -26.0 < ridge_db < -18.0
    assert copy["sidebands"] == []
    assert copy["leakage"]["range_m"] == pytest.approx(note["leakage"]["range_m"], abs=0.1)
    assert copy["leakage"]["level_db"] == pytest.approx(note["leakage"]["level_db"], abs=0.5)
    for span, level_db in note["noise_db"].items():
        assert copy["noise_db"][span] == pytest.approx(level_db, abs=4.0)
        assert note["floor_db"][span] > copy["floor_db"][span] + 10.0
    (spur,), (copied,) = note["spurs_khz_db_of_leakage"], copy["spurs_khz_db_of_leakage"]
    assert copied == pytest.approx(spur, abs=0.6)
    # what lies at negative range is louder than what it would be the image of
    assert note["strongest_negative"]["level_db"] > note["strongest_negative"]["mirror_db"] + 10.0
    draw(real, twin, tmp_path / "burst.png")
    assert (tmp_path / "burst.png").stat().st_size > 0


@pytest.mark.slow
def test_faults_of_a_simulated_board_come_back_and_go_into_a_scene(tmp_path: Path) -> None:
    """Layout: the kit's chirp, a person at 6.5 m, leakage of -45 dBm at 1.2 m, a tone of -90 dBm between the echoes'
    lines, Q louder by 0.3 dB and 2 deg late, 1 W. Measured, written to a scene, simulated, measured again. Tolerance:
    0.5 dB, 0.05 m, 1 kHz; gain 0.05 dB and phase 0.3 deg, for the noise in the image's bins."""
    front_end = FrontEnd(
        leakage_dbm=-45.0, leakage_range_m=1.2, iq_gain_db=0.3, iq_phase_deg=2.0,
        spurs=(Spur(frequency_hz=611.3e3, power_dbm=-90.0),),
    )  # fmt: skip
    scene = scene_from_yaml(SCENE)
    scene = msgspec.structs.replace(scene, radar=msgspec.structs.replace(scene.radar, front_end=front_end))
    board = setup()
    # far above the rounding of codes of -20 dBm full scale
    noisy = msgspec.structs.replace(board.radar, noise_figure_db=26.0, transmit_power_w=1.0)
    board = msgspec.structs.replace(board, radar=noisy)
    faults = msgspec.structs.replace(FAULTS, image_about_hz=0.0)
    for attempt in range(2):
        floor = measured(played(scene, board, attempt), faults, tmp_path / f"{attempt}.sigmf-meta")
        assert floor.noise_figure_db == pytest.approx(26.0, abs=0.5)
        assert floor.leakage is not None
        assert floor.leakage.power_dbm == pytest.approx(-45.0, abs=0.5)
        assert floor.leakage.range_m == pytest.approx(1.2, abs=0.05)
        assert floor.imbalance is not None
        assert floor.imbalance.gain_db == pytest.approx(0.3, abs=0.05)
        assert floor.imbalance.phase_deg == pytest.approx(2.0, abs=0.3)
        (spur,) = floor.spurs
        assert spur.frequency_hz == pytest.approx(611.3e3, abs=1e3)
        assert spur.power_dbm == pytest.approx(-90.0, abs=0.5)
        plain = tmp_path / f"plain_{attempt}.yaml"
        plain.write_text(scene_to_yaml(scene_from_yaml(SCENE)))
        written = tmp_path / f"as_measured_{attempt}.yaml"
        written.write_text(scene_with_receiver(plain, floor))
        scene = load_scene(written)
