"""`mirrorwave compare` on a tiny run: what is written, resumption, failed rows, what options are refused."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest
from matplotlib.figure import Figure

from lab.compare.comparison_figures import draw_comparison
from lab.compare.comparison_report import Reach, Report, Row, make_report, markdown, roughness_loss_db
from lab.compare.comparison_scenes import WALLS, Corner, WallKind, corner_scene, shown_points
from lab.compare.one_scene import sensors_of
from lab.compare.peak_scores import Score, score
from lab.compare.sensors import SENSORS, Sight, SpadSensor, count_threshold
from lab.compare.sweeps import Plan, SceneResult, Seen, run_plan
from lab.studies.report import Interval, write_report
from mirrorwave import cli
from msgs.files.shipped import CHECKOUT
from sim_player.scene.description import load_scene
from tests.figures import assert_readable_at_page_width

PLAN = Plan(
    seed=3,
    viewpoints=1,
    equal="power",
    sensors=["xband", "77ghz"],
    values={"range": [8.0, 60.0], "roughness": [0.0, 0.5], "material": ["metal", "plywood"]},
)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, list[SceneResult], Report]]:
    """A run; plywood, which has no value at 77 GHz, stands among its walls."""
    out = tmp_path_factory.mktemp("compare")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(WALLS, "plywood", WallKind("plywood", 20.0, 0.1))
        results = run_plan(PLAN, out)
        yield out, results, make_report(PLAN, results, "here")


def row_of(report: Report, sweep: str, value: float | str, sensor: str) -> Row:
    return next(row for row in report.rows if (row.sweep, row.value, row.sensor) == (sweep, value, sensor))


@pytest.mark.slow
def test_all_files_are_written_and_say_the_same(
    made: tuple[Path, list[SceneResult], Report], saved_figures: list[Figure]
) -> None:
    out, _, report = made
    write_report(out, "compare", report, markdown(report))
    draw_comparison(report, out / "compare.png")
    assert msgspec.json.decode((out / "compare.json").read_bytes(), type=Report) == report
    text = (out / "compare.md").read_text()
    assert text == markdown(report)
    assert (out / "compare.png").stat().st_size > 10_000
    assert_readable_at_page_width(saved_figures[-1])


@pytest.mark.slow
def test_panels_of_one_question_share_their_scale(
    made: tuple[Path, list[SceneResult], Report], saved_figures: list[Figure], tmp_path: Path
) -> None:
    """Three ranges side by side, levels of 30 and of 90 dB among them: one scale, named once."""
    report = made[2]
    rows = [row for row in report.rows if row.sweep == "range"]
    rows += [msgspec.structs.replace(row, sweep="range_glass", snr_db=90.0) for row in rows]
    draw_comparison(msgspec.structs.replace(report, rows=rows), tmp_path / "a.png")
    panels = {axes.get_title(): axes for axes in saved_figures[-1].axes}
    first, second = panels["Level behind concrete"], panels["Level behind float glass"]
    assert first.get_ylim() == second.get_ylim()
    assert first.get_ylim()[1] > 90.0
    assert [bool(axes.get_ylabel()) for axes in (first, second)] == [True, False]
    assert first.get_xlabel() == "range to the image [m]"


def test_near_is_found_and_x_band_reaches_farther(made: tuple[Path, list[SceneResult], Report]) -> None:
    report = made[2]
    near, far = row_of(report, "range", 8.0, "77ghz"), row_of(report, "range", 60.0, "77ghz")
    assert near.found is not None
    assert far.found is not None
    assert (near.found.value, far.found.value) == (1.0, 0.0)
    xband = row_of(report, "range", 60.0, "xband")
    assert xband.found is not None
    assert xband.found.value == 1.0
    reach = {one.sensor: one for one in report.reaches if (one.sweep, one.measure) == ("range", "found")}
    assert reach["xband"].at_least
    assert 8.0 < reach["77ghz"].half < 60.0
    assert reach["77ghz"].ratio_at_least


def test_levels_follow_the_radar_equation(made: tuple[Path, list[SceneResult], Report]) -> None:
    """R^-4 from 8 to 60 m: 35 dB. The class's mean echo against one car of one aspect: within 8 dB."""
    near, far = (row_of(made[2], "range", value, "xband") for value in (8.0, 60.0))
    for row in (near, far):
        assert row.snr_db == pytest.approx(row.predicted_snr_db, abs=8.0)
    assert near.predicted_snr_db is not None
    assert far.predicted_snr_db is not None
    assert near.predicted_snr_db - far.predicted_snr_db == pytest.approx(40.0 * np.log10(60.0 / 8.0), abs=1.0)


def test_roughness_takes_what_the_closed_form_says(made: tuple[Path, list[SceneResult], Report]) -> None:
    """0.5 mm at 77 GHz, two bounces: 11.3 dB at 45 deg; a car 8 m away is met at 30..60 deg. X-band: 0.19 dB.

    Points add up in phase, each with its own loss: the strongest cell may leave the band by a few dB.
    """
    row = row_of(made[2], "roughness", 0.5, "77ghz")
    assert row.loss_db is not None
    assert row.least_loss_db is not None
    assert row.most_loss_db is not None
    assert row.least_loss_db < 11.3 < row.most_loss_db
    assert row.least_loss_db - 3.0 < row.loss_db < row.most_loss_db + 3.0
    xband = row_of(made[2], "roughness", 0.5, "xband")
    assert xband.loss_db == pytest.approx(0.19, abs=0.2)
    # light: the squared excess falls twice as fast
    assert roughness_loss_db(SENSORS["spad"], 1e-8, 1.0) == pytest.approx(
        4.0 * 4.343 * (0.04 * np.pi / 0.85) ** 2, rel=1e-3
    )


def test_a_wall_unknown_to_a_sensor_keeps_its_row(made: tuple[Path, list[SceneResult], Report]) -> None:
    row = row_of(made[2], "material", "plywood", "77ghz")
    assert row.scans == 0
    assert row.f1_1m is None
    assert row.failed is not None
    assert "plywood" in row.failed
    assert row_of(made[2], "material", "plywood", "xband").failed is None
    assert "| plywood | 77ghz | failed |" in markdown(made[2])


def test_an_empty_map_counts_its_misses() -> None:
    scene = corner_scene(Corner(), 1)
    truth = shown_points(scene)
    sight = SENSORS["xband"].look(scene, 1, 1, "power")
    blind = Sight(sight.ra_map, np.array(np.inf), sight.ridges, sight.peaks)
    found = score(blind, scene, truth)
    assert found.within_1m == (0, 0, len(truth))
    assert (found.hidden, found.found, found.false_objects) == (1, 0, 0)


HIT, MISS = (4, 0, 0), (0, 0, 4)


def made_up(sweep: str, seen: dict[str, list[list[tuple[int, int, int]]]]) -> Report:
    """A report of counts [value][viewpoint] of each sensor."""
    values = [8.0, 10.0, 60.0]
    first = next(iter(seen.values()))
    plan = Plan(seed=0, viewpoints=len(first[0]), equal="power", sensors=list(seen), values={sweep: values})  # type: ignore[dict-item]

    def score_of(counts: tuple[int, int, int]) -> Score:
        return Score(within_1m=counts, within_2m=counts, hidden=1, found=counts[0] > 0, false_objects=0, snr_db=None)

    results = [
        SceneResult(
            sweep=sweep,
            index=index,
            viewpoint=viewpoint,
            seen={name: Seen(score=score_of(counts[index][viewpoint])) for name, counts in seen.items()},
        )
        for index in range(len(first))
        for viewpoint in range(plan.viewpoints)
    ]
    return make_report(plan, results, "here")


def reach_of(report: Report, sensor: str) -> Reach:
    return next(one for one in report.reaches if (one.sensor, one.measure) == (sensor, "f1_1m"))


def test_a_reach_names_its_bracket_and_what_it_is_held_against() -> None:
    report = made_up("range", {"77ghz": [[HIT], [HIT], [HIT]], "spad": [[HIT], [MISS], [MISS]]})
    one = reach_of(report, "spad")
    assert (one.half, one.between, one.reference, one.ratio_at_least) == (9.0, (8.0, 10.0), "77ghz", True)
    assert one.ratio == pytest.approx(60.0 / 9.0)
    # one viewpoint has no interval
    assert row_of(report, "range", 8.0, "spad").f1_1m == Interval(value=1.0, low=None, high=None)


def test_a_lucky_point_is_no_reach() -> None:
    """One viewpoint of twelve, at the farthest: zero lies in its interval. Nobody is held against one who sees none."""
    lucky = [[MISS] * 12, [MISS] * 12, [HIT, *[MISS] * 11]]
    report = made_up("range", {"xband": lucky, "77ghz": [[HIT] * 12, [MISS] * 12, [MISS] * 12]})
    assert (reach_of(report, "xband").half, reach_of(report, "xband").at_least) == (0.0, False)
    assert reach_of(report, "77ghz").ratio is None


def test_a_scene_with_a_lidar_is_seen_by_its_own() -> None:
    scene = load_scene(Path("launch/scenes/hidden_car_spad.yaml"))
    own = sensors_of(scene)[-1]
    assert isinstance(own, SpadSensor)
    assert (own.name, own.params("power")) == ("scene", scene.radar.spad)
    radars = load_scene(Path("launch/scenes/hidden_car_xband.yaml"))
    assert [one.name for one in sensors_of(radars)] == ["xband", "77ghz", "spad_long"]
    with pytest.raises(ValueError, match=r"--sensor must be one of .*, got 'scene'"):
        sensors_of(radars, ["scene"])


@pytest.mark.slow
def test_a_wall_across_a_gates_border_is_no_crowd() -> None:
    """The relay wall passes 10 m, a border of gates: four points were made up behind it where a bin crossed that."""
    spad = SENSORS["spad_long"].params("power")  # type: ignore[attr-defined]
    assert spad.bins % spad.gates == 0
    scene = corner_scene(Corner(range_m=20.0), 5, 0)
    found = score(SENSORS["spad_long"].look(scene, 0, 100, "power"), scene, shown_points(scene))
    assert (found.within_2m[1], found.false_objects) == (0, 0)


def test_equal_energy_is_equal() -> None:
    energies = [sensor.energy_j("energy") for sensor in SENSORS.values()]
    assert energies == pytest.approx([25 * 128 * 8192 / 1.5e9 * 1.6e-3] * len(energies), rel=1e-9)


def test_few_counts_ask_for_more_than_a_normal_law() -> None:
    """Table 2 has thousands of counts a cell: nearly 4.75 sigma; the long period tens: more; nothing beyond 10 m."""
    many, few = (count_threshold(SENSORS[name].params("power")) for name in ("spad", "spad_long"))  # type: ignore[attr-defined]
    assert np.sqrt(many[10]) == pytest.approx(4.75, abs=0.15)
    assert np.sqrt(few[10]) > 5.0
    assert np.isinf(many[60])
    assert np.isfinite(few[500])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--sweep", "weather"], "--sweep must be one of range, "),
        (["--sensor", "ears"], "sensor must be one of xband, 77ghz, "),
        (["--equal", "weight"], "--equal must be one of power, energy, got 'weight'"),
        (["--viewpoints", "0"], "viewpoints must lie in 1..1000, got 0"),
        (["--viewpoints", "100000000000"], "viewpoints must lie in 1..1000, got 100000000000"),
        (["--jobs", "0"], "Invalid value for '--workers'"),
        (["--seed", "-1"], "seed must not be negative, got -1"),
        (["--scene", "no-such.yaml"], "--sweep, --quick and --viewpoints do not go with --scene, got 'no-such.yaml'"),
    ],
)
def test_wrong_options_are_one_line(
    words: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["compare", "--quick", "--out", str(tmp_path / "run"), *words]) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1


def test_a_scene_of_a_material_unknown_to_the_sensor_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = tmp_path / "scene.yaml"
    scene.write_text((CHECKOUT / "launch" / "scenes" / "corner.yaml").read_text().replace("brick", "plywood"))
    assert cli.main(["compare", "--out", str(tmp_path / "run"), "--scene", str(scene), "--sensor", "77ghz"]) == 2
    said = capsys.readouterr().err
    assert "scene 'bend': surfaces[0].material: material plywood is known for 1..40 GHz, got 77 GHz" in said
    assert said.count("\n") == 1


@pytest.mark.slow
def test_one_scene_through_two_radars(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The picture goes by the scene's name, as far as a file may."""
    scene = tmp_path / "file.yaml"
    text = Path("launch/scenes/hidden_car_xband.yaml").read_text(encoding="utf-8")
    scene.write_text(text.replace("name: hidden_car_xband", "name: a car/hidden"), encoding="utf-8")
    words = ["--scene", str(scene), "--sensor", "xband", "--sensor", "77ghz"]
    assert cli.main(["compare", *words, "--out", str(tmp_path), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert [one["sensor"] for one in said] == ["xband", "77ghz"]
    assert all(one["hidden"] >= 1 for one in said)
    assert (tmp_path / "a_car_hidden.png").stat().st_size > 10_000
