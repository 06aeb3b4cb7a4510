"""`mirrorwave eval --objects` on a few places: rows, resumption, workers, the committed sets, what is refused."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import msgspec
import pytest

from lab.evaluate.labelled_beams import LabelledPlace
from lab.evaluate.place_report import ObjectRequest, measured, tables
from lab.evaluate.place_runs import ObjectPlan, ObjectSet, image_truth, measure_place, read_sets, run_objects
from lab.measures.object_rows import FOUND_M
from lab.tradeoff.rows import profile_setting
from mirrorwave.cli import main
from models.perception.track.views_over_scans import ViewStage
from msgs.values.environment import WallPriors
from sim_player.generate.places import draw_place
from sim_player.scene.description import scene_sha256

SEED, PLACES = 5, 3
WORDS = ("eval", "--objects", "--profile", "cfar", "--profile", "default", "--seed", str(SEED), "--places", str(PLACES))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One run of three places, of which the second holds three objects out of sight."""
    out = tmp_path_factory.mktemp("objects")
    assert main([*WORDS, "--effects", "basic", "--out", str(out)]) == 0
    return out


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.slow
def test_report_counts_what_the_rows_hold(made: Path) -> None:
    report = json.loads((made / "results.json").read_text())
    one = report["sets"]["drawn"]
    assert (one["seed"], one["places"], one["moving"], one["effects"]) == (SEED, PLACES, False, "basic")
    rows = [json.loads(path.read_text()) for path in sorted((made / "drawn" / "places").glob("*.json"))]
    assert [row["place"] for row in rows] == list(range(PLACES))
    for profile in ("cfar", "default"):
        hidden = [
            one for row in rows for scan in row["rows"][profile] for one in scan["hidden"] if one["image"]["mirrored"]
        ]
        found = [one["error_m"] for one in hidden if one["error_m"] is not None]
        assert hidden
        assert max(found, default=0.0) <= FOUND_M
        recall = one["profiles"][profile]["recall"]
        assert (recall["part"], recall["whole"]) == (len(found), len(hidden))
        assert one["profiles"][profile]["reports"] == sum(
            len(scan["reports"]) for row in rows for scan in row["rows"][profile]
        )
    digests = b"".join(bytes.fromhex(scene_sha256(draw_place(SEED, index).scene)) for index in range(PLACES))
    assert one["scenes_sha256"] == hashlib.sha256(digests).hexdigest()


def test_page_and_terminal_say_the_same(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*WORDS, "--effects", "basic", "--out", str(made)]) == 0
    printed, page = capsys.readouterr().out, (made / "results.md").read_text()
    recall = json.loads((made / "results.json").read_text())["sets"]["drawn"]["profiles"]["default"]["recall"]
    words = f"{recall['part']:g} of {recall['whole']:g}"
    assert words in printed
    assert words in page
    assert "- error: from the position of the report to the nearest visible face" in page


@pytest.mark.slow
def test_two_workers_and_a_stopped_run_give_the_same_bytes(made: Path, tmp_path: Path) -> None:
    whole = files(made)
    (made / "drawn" / "places" / "place-00001.json").unlink()
    assert main([*WORDS, "--effects", "basic", "--out", str(made)]) == 0
    assert files(made) == whole
    twice = [*WORDS, "--effects", "basic", "--workers", "2", "--out", str(tmp_path)]
    assert main(twice) == 0
    assert files(tmp_path) == whole


@pytest.mark.slow
def test_places_that_are_not_those_of_the_set_are_refused(tmp_path: Path) -> None:
    wrong = ObjectSet(seed=SEED, places=1, effects="basic", scenes_sha256="0" * 64)
    with pytest.raises(ValueError, match=r"scenes_sha256 of the places must be 0000.* as the set says, got"):
        run_objects(ObjectPlan(set=wrong, profiles=[profile_setting("cfar")]), tmp_path)


@pytest.mark.slow
def test_the_smaller_committed_sets_still_draw_the_places_that_were_hashed() -> None:
    """Of each kind one: at rest, in motion, shifted, drives; without simulating them. An evaluation refuses the others
    where they differ.
    """
    kinds: dict[object, tuple[str, ObjectSet]] = {}
    for name, one in sorted(read_sets().sets.items(), key=lambda item: -item[1].places):
        kinds[one.moving, one.shift, one.scans, one.world] = name, one
    small = dict(found for found in kinds.values() if found[1].places <= 100)
    assert {(one.moving, one.shift, one.scans) for one in small.values()} >= {
        (True, "none", 1), (False, "hard", 1), (False, "none", 12)
    }  # fmt: skip
    assert {one.world for one in small.values()} == {"own", "foreign"}
    for name, one in small.items():
        digest = hashlib.sha256()
        for index in range(one.places):
            digest.update(bytes.fromhex(scene_sha256(one.place(index).scene)))
        assert digest.hexdigest() == one.scenes_sha256, name


def test_no_two_sets_share_a_seed() -> None:
    seeds = [one.seed for one in read_sets().sets.values()]
    assert len(set(seeds)) == len(seeds)


@pytest.mark.slow
def test_motion_reaches_the_chain() -> None:
    """A place in motion: its scene moves, its rows are scored all the same."""
    plan = ObjectPlan(
        set=ObjectSet(seed=SEED, places=1, moving=True, effects="basic"), profiles=[profile_setting("cfar")]
    )
    player = LabelledPlace(SEED, 0, "basic", True).player
    assert player.scene.moves
    result = measure_place((plan, 0))
    out_of_sight = [one for one in image_truth(player) if not one.direct]
    assert [one.image for one in result.rows["cfar"][0].hidden] == out_of_sight


@pytest.mark.slow
def test_walls_of_a_map_reach_the_chain(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every scan of a drive begins with the walls about the vehicle there: the poor map lacks some of them."""
    heard: list[WallPriors] = []
    monkeypatch.setattr(ViewStage, "add_walls", lambda _, message: heard.append(message))
    drive = ObjectSet(seed=SEED, places=1, effects="basic", scans=2)
    for walls in ("none", "true", "noisy"):
        measure_place((ObjectPlan(set=drive, profiles=[profile_setting("cfar")], walls=walls), 0))
    player = drive.place(0).player
    assert [message.stamp_ns for message in heard] == 2 * [player.stamp_ns(0), player.stamp_ns(1)]
    exact, _, poor, _ = heard
    assert 0 < len(poor.walls) < len(exact.walls)
    assert (exact.walls[0].offset_std_m, poor.walls[0].offset_std_m) == (0.01, 0.2)


def test_loss_of_several_sets_is_their_mean(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    sets = read_sets()
    small = {name: ObjectSet(seed=seed, places=1, effects="basic") for name, seed in (("a", 1), ("b", 2))}
    monkeypatch.setattr(
        "lab.evaluate.place_report.read_sets", lambda: msgspec.structs.replace(sets, sets=small, false_cost=0.25)
    )
    request = ObjectRequest(
        sets=["a", "b"], profiles=["cfar"], places=None, moving=False, effects="all", walls="none", seed=0,
        draws=5, workers=1, out=tmp_path,
    )  # fmt: skip
    results = measured(request)
    losses = [one["profiles"]["cfar"].loss.value for one in results["sets"].values()]
    assert results["false_cost"] == 0.25
    assert results["mean_loss"]["cfar"] == pytest.approx(sum(losses) / 2.0)
    assert [title for title, _, _ in tables(results)][-1] == "mean loss over the sets, false cost 0.25"


@pytest.mark.parametrize(
    ("words", "fault"),
    [
        (["--objects", "--data", "x"], "--data must not be given with --objects"),
        (["--objects", "--method", "cfar"], "--method must not be given with --objects"),
        (["--objects", "--set", "nowhere"], "--set must be one of report, report_moving, validation"),
        (["--objects", "--set", "report", "--places", "3"], "leave out --count, --moving and --effects"),
        (["--objects", "--set", "report", "--set", "report"], "must each name a thing once"),
        (["--objects", "--profile", "magic"], "unknown profile 'magic'; known are default, accurate"),
        (["--objects", "--places", "1", "--effects", "wind"], "wind"),
        (["--data", "x", "--walls", "true"], "--walls must not be given with --data"),
        (["--data", "x", "--profile", "cfar"], "--profile must not be given with --data"),
        ([], "--data must name a data set, or --objects ask for random places"),
    ],
)
def test_options_that_do_not_fit_are_refused_in_one_line(
    words: list[str], fault: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["eval", *words]) == 2
    err = capsys.readouterr().err.strip()
    assert fault in err
    assert "\n" not in err


def test_a_foreign_world_is_at_rest_and_not_shifted() -> None:
    for wrong in ({"moving": True}, {"scans": 3}, {"shift": "hard"}):
        with pytest.raises(ValueError, match="world: foreign needs places at rest without a shift"):
            ObjectSet(seed=SEED, places=1, world="foreign", **wrong)  # type: ignore[arg-type]
