"""Reflectance tables: the shipped one against the exact stack and Kirchhoff, its gaps, its file, resumable builds."""

from __future__ import annotations

import math
import shutil
from pathlib import Path

import msgspec
import numpy as np
import pytest

from lab.full_wave import reflectance
from lab.full_wave.reflectance import (
    BANDS_HZ,
    MEASURED,
    POLARISATIONS,
    REFUSED,
    RINGING,
    SHIPPED,
    STATUS,
    UNSURE,
    WALLS,
    Cell,
    Done,
    Entry,
    ReflectanceTable,
    build_tables,
    cut_opaque,
    layers_of,
    load_table,
    mirror_field,
    simulate,
    table_entries,
)
from models.physics.fresnel import coherent_power, stack_reflection

SPEED_OF_LIGHT_MPS = 299_792_458.0
SMOOTH = Entry("asphalt", 10e9, "te", 0.0, (0.0, 45.0))


@pytest.fixture(scope="module")
def table() -> ReflectanceTable:
    return load_table()


def exact_power(wall: str, frequency_hz: float, polarisation: str, angle_deg: np.ndarray) -> np.ndarray:
    media, thicknesses_m = zip(*layers_of(wall, frequency_hz), strict=True)
    cosine = np.cos(np.radians(angle_deg))
    wavelength_m = SPEED_OF_LIGHT_MPS / frequency_hz
    return np.abs(stack_reflection(media, thicknesses_m, cosine, wavelength_m, polarisation)) ** 2  # type: ignore[arg-type]


def test_the_shipped_table_says_where_it_comes_from(table: ReflectanceTable) -> None:
    assert SHIPPED.stat().st_size + SHIPPED.with_suffix(".json").stat().st_size < 200_000
    assert {"command", "version", "machine", "date", "sha256", "smooth", "rough", "walls"} <= set(table.card)
    assert table.card["rough"]["seeds"] == [0, 1, 2]
    assert sum(table.card["status"].values()) == table.status.size
    notes = {row["name"]: [band["note"] for band in row["bands"]] for row in table.card["walls"]}
    assert notes["brick"][0] == ""
    assert notes["brick"][1].startswith("interpolated between 40 and 110 GHz")
    assert notes["concrete"] == ["opaque: simulated as a half-space"] * 2


def test_smooth_walls_equal_the_exact_stack(table: ReflectanceTable) -> None:
    """Layout: column of cells, 20 a wavelength; analytic: stack of layers; bias: second order in the cell, largest at
    the null of TM and where a slab resonates; tolerance: 0.01 of |r|^2 absolute and, for TE, 0.1 dB."""
    for w, wall in enumerate(WALLS):
        for f, band in enumerate(BANDS_HZ):
            for p, polarisation in enumerate(POLARISATIONS):
                exact = exact_power(wall, band, polarisation, table.smooth_angle_deg)
                found = np.square(np.abs(table.smooth_r[w, f, p]))
                np.testing.assert_allclose(found, exact, atol=0.01, rtol=0.0)
                if polarisation == "te":
                    assert np.abs(10.0 * np.log10(found / exact)).max() < 0.1, (wall, band)


def test_rough_concrete_in_te_keeps_kirchhoffs_factor(table: ReflectanceTable) -> None:
    """Layout: strips of 16 wavelengths, three surfaces a cell; analytic: |r|^2 exp(-g^2), down to -12 dB of it; bias:
    +0.1 dB of square cells; tolerance: what `compare` counts, 0.5 dB."""
    rows = [one for one in table.compare() if (one.wall, one.polarisation) == ("concrete", "te")]
    assert [(one.frequency_hz, one.agreeing, len(one.angles_deg)) for one in rows if one.roughness_m > 0.0] == [
        (band, 3, 3) for band in BANDS_HZ for _ in range(3)
    ]


def test_a_rough_front_on_a_thin_board_leaves_the_formula(table: ReflectanceTable) -> None:
    """The back face stays smooth and mirrors on: at 2 mm rms and 10 GHz more is left than Kirchhoff's factor says."""
    (row,) = [one for one in table.compare() if (one.wall, one.roughness_m) == ("plasterboard", 2e-3)]
    assert row.difference_db[0] > 0.5 + row.error_db[0]


def test_what_is_scattered_is_not_lost(table: ReflectanceTable) -> None:
    """Rough metal reflects all of it at every angle, and the diffuse share is what the mirror lacks (0.08 of 1)."""
    at = (list(table.walls).index("metal"), list(table.bands_hz).index(10e9), 0)
    cosine = np.cos(np.radians(table.rough_angle_deg))
    reflected = table.reflected_share[at]
    smooth = np.square(np.abs(table.smooth_r[at][np.searchsorted(table.smooth_angle_deg, table.rough_angle_deg)]))
    diffuse = 1.0 - table.specular_share[at] / reflected
    np.testing.assert_allclose(reflected * smooth, 1.0, atol=0.01)
    left = coherent_power(table.roughness_m[0][:, None], cosine, SPEED_OF_LIGHT_MPS / 10e9)
    np.testing.assert_allclose(diffuse, 1.0 - left, atol=0.08)


def test_every_absent_cell_has_its_reason(table: ReflectanceTable) -> None:
    rows = table.absent()
    assert len(rows) == np.count_nonzero(table.status != MEASURED)
    assert {row[-1] for row in rows} <= set(STATUS[1:])
    assert np.isnan(table.specular_share[table.status != MEASURED]).all()
    assert (table.error_db[table.status == MEASURED] <= reflectance.MAX_ERROR_DB).all()


def test_a_changed_file_is_refused(tmp_path: Path) -> None:
    for suffix in (".npz", ".json"):
        shutil.copy(SHIPPED.with_suffix(suffix), tmp_path / f"a{suffix}")
    data = bytearray((tmp_path / "a.npz").read_bytes())
    data[len(data) // 2] ^= 1
    (tmp_path / "a.npz").write_bytes(data)
    with pytest.raises(ValueError, match="SHA-256 must be that of its card"):
        load_table(tmp_path / "a.npz")


def test_kirchhoffs_sum_takes_the_chance_of_a_surface_out() -> None:
    """Surfaces whose r_0 is c times their Kirchhoff sum: the mean is c exp(-g^2/2) whatever the draw, error zero; a
    part that K does not carry shows as error."""
    rng = np.random.default_rng([4, 1])
    kirchhoff = 0.5 + 0.2 * (rng.standard_normal(3) + 1j * rng.standard_normal(3))
    mean, error = mirror_field((0.9 - 0.1j) * kirchhoff, kirchhoff, 1.2)
    assert mean == pytest.approx((0.9 - 0.1j) * math.exp(-0.72))
    assert error == pytest.approx(0.0, abs=1e-12)
    _, error = mirror_field(kirchhoff + np.array([0.1, -0.1, 0.0]), kirchhoff, 1.2)
    assert 0.02 < error < 0.1


def test_opaque_walls_are_cut_and_nothing_changes() -> None:
    """25 cm of concrete hide 100 dB of way, 24 cm of brick 14 dB; behind the cut |r| changes by less than 1e-4."""
    concrete, brick = layers_of("concrete", 10e9), layers_of("brick", 10e9)
    assert cut_opaque(concrete, 10e9) == ((concrete[0][0], math.inf),)
    assert cut_opaque(brick, 10e9) == brick
    wavelength_m = SPEED_OF_LIGHT_MPS / 10e9
    whole = stack_reflection([concrete[0][0]], [0.25], np.array(1.0), wavelength_m)
    cut = stack_reflection([concrete[0][0]], [math.inf], np.array(1.0), wavelength_m)
    assert abs(whole - cut) < 1e-4


@pytest.mark.slow
def test_a_rough_cell_is_measured_against_the_smooth_wall() -> None:
    """Plasterboard at 77 GHz, 0.1 mm, normal incidence, two surfaces: Kirchhoff's -0.45 dB within 0.25 dB."""
    (cell,) = simulate(Entry("plasterboard", 77e9, "te", 1e-4, (0.0,), (0, 1))).cells
    assert 10.0 * math.log10(cell.specular) == pytest.approx(-0.45, abs=0.25)
    assert cell.specular < cell.reflected < 1.1
    assert cell.error_db < 0.1


def test_a_stopped_build_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the file holds is not simulated again; a torn line, or one of other settings, is."""
    partial = tmp_path / "t.cells.jsonl"
    seen: list[tuple[int, int]] = []
    entries = [SMOOTH, msgspec.structs.replace(SMOOTH, polarisation="tm")]
    whole = build_tables(entries, lambda done, total: seen.append((done, total)), partial)
    assert seen == [(0, 2), (1, 2), (2, 2)]
    lines = partial.read_bytes().splitlines()
    partial.write_bytes(lines[0] + b"\n" + lines[1][:40])
    asked: list[Entry] = []
    monkeypatch.setattr(reflectance, "simulate", lambda entry: (asked.append(entry), simulate(entry))[1])
    assert build_tables(entries, None, partial).to_bytes() == whole.to_bytes()
    assert asked == entries[1:]
    monkeypatch.setattr(reflectance, "SETTINGS", (1.0,))
    build_tables(entries, None, partial)
    assert asked == entries[1:] + entries


def test_what_is_not_to_be_trusted_is_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A lobe drowned in speckle and a wall that rings keep no specular value; saving and loading keeps the table."""
    cells = {
        0.0: Cell(0.0, specular=0.5, error_db=0.1, lobe=0.5, reflected=1.0),
        30.0: Cell(30.0, specular=0.5, error_db=2.0, lobe=0.4, reflected=1.0),
        60.0: Cell(60.0, specular=0.5, error_db=0.1, lobe=0.5, reflected=1.0, residue=0.1),
    }
    monkeypatch.setattr(reflectance, "simulate", lambda entry: Done(entry, tuple(cells[a] for a in entry.angles_deg)))
    found = build_tables([Entry("metal", 10e9, "te", 1e-3, tuple(cells))])
    np.testing.assert_array_equal(found.status[0, 0, 0, 0], [MEASURED, UNSURE, RINGING])
    assert (found.status[0, 0, 1] == REFUSED).all()
    np.testing.assert_array_equal(np.isfinite(found.specular_share[0, 0, 0, 0]), [True, False, False])
    found.save(tmp_path / "t.npz", {"date": "2026-01-01"})
    again = load_table(tmp_path / "t.npz")
    assert again.to_bytes() == found.to_bytes()
    assert again.card["date"] == "2026-01-01"


def test_entries_of_the_shipped_table_are_legal(table: ReflectanceTable) -> None:
    entries = table_entries()
    assert len(set(entries)) == len(entries)
    assert {entry.wall for entry in entries} == set(table.walls)
    with pytest.raises(ValueError, match="wall must be one of"):
        Entry("cheese", 10e9, "te", 0.0, (0.0,))
    with pytest.raises(ValueError, match="two seeds or more"):
        Entry("metal", 10e9, "te", 1e-3, (0.0,), (0,))
