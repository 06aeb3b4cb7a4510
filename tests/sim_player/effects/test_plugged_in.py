"""Effects of other packages: planned like ours, or left out with one line; each case in a process of its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from msgs.files.plugins import EFFECTS
from msgs.files.shipped import CHECKOUT
from tests.plugins import write_package

#: A weight effect: half the field of every echo; and a path effect: objects in direct sight again, 10 dB weaker.
HALF = """
ABOUT = "half the field"
def absent(world):
    return None if len(world.centre_m) else "the scene holds no object"
def factor(echoes, world, used):
    return 0.5 if used else 1.0
"""
GHOSTS = """
from sim_player.trace.effect_names import bit
from sim_player.trace.echoes import cofocal, object_echoes

ABOUT = "ghosts of objects"
def absent(world):
    return None
def apply(tracing):
    routes, occlusion = tracing.straight
    clear = routes.take(occlusion.free)
    echoes = object_echoes(tracing.view, clear, cofocal(clear), bit("ghosts"))
    return echoes.with_columns(weight=0.316 * echoes.weight, out_m=echoes.out_m + 3.0, back_m=echoes.back_m + 3.0)
"""
SCENE = """
from sim_player.scene.description import Scene, SceneObject, Surface
from sim_player.scene.world import prepare
wall = Surface(role="relay", material="concrete", polyline_m=((20.0, -10.0), (20.0, 15.0)), thickness_mm=300)
scene = Scene(name="t", surfaces=(wall,), objects=(SceneObject(class_="car", x_m=12.0, y_m=2.0),))
world = prepare(scene, 0)
"""


def run(folder: Path, script: str) -> tuple[dict, list[str]]:
    """Run a script beside packages; what it prints as JSON, and the lines of its log."""
    paths = [str(folder), str(CHECKOUT), *filter(None, [os.environ.get("PYTHONPATH")])]
    variables = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    done = subprocess.run(
        [sys.executable, "-c", f"import json\n{script}"], env=variables, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout), [line for line in done.stderr.splitlines() if line.startswith("effect ")]


def test_effects_of_other_packages_are_planned_like_ours(tmp_path: Path) -> None:
    """They are rows of the table behind ours; the planner bounds what they change, skips the one that is under the
    budget, and drops each one's paths alone; the weight effect halves every path; ghosts have no truth points."""
    sources = {"half": HALF, "ghosts": GHOSTS, "tiny": HALF.replace("0.5 if", "0.99999999 if")}
    write_package(tmp_path, "acme", EFFECTS, {name: name for name in sources}, **sources)
    script = f"""{SCENE}
import numpy as np
from sim_player.trace.effect_names import bit
from sim_player.effects.table import ALL_EFFECTS, PATHS, SHIPPED, WEIGHTS
from sim_player.planner.plan import manual_plan, plan_world
from sim_player.paths.truth import labelled
every = manual_plan(world, scene.setup)
whole = manual_plan(world, scene.setup, ALL_EFFECTS - {{"half", "tiny"}})
plan = plan_world(world, scene.setup, thorough=True)
rows = {{effect.name: effect for effect in plan.effects}}
ghosts = (every.paths.needs & bit("ghosts")) != 0
print(json.dumps({{
    "last": [list(PATHS)[-1], list(WEIGHTS)[-1]],
    "new": sorted(ALL_EFFECTS - SHIPPED),
    "ratio": float(np.abs(every.paths.amplitude / whole.paths.amplitude - 0.499999995).max()),
    "ghosts": int(ghosts.sum()),
    "without": int((manual_plan(world, scene.setup, ALL_EFFECTS - {{"ghosts"}}).paths.needs & bit("ghosts")).any()),
    "labelled": int(labelled(every.paths)[ghosts].sum()),
    "used": [rows[name].used for name in ("half", "ghosts", "tiny")],
    "bounds_db": [rows[name].bound_db for name in ("half", "ghosts", "tiny")],
}}))
"""
    answer, log = run(tmp_path, script)
    assert log == []
    assert answer["last"] == ["ghosts", "tiny"]
    assert answer["new"] == ["ghosts", "half", "tiny"]
    assert answer["ratio"] < 1e-12
    assert answer["ghosts"] > 0
    assert (answer["without"], answer["labelled"]) == (0, 0)
    assert answer["used"] == [True, True, False]
    half_db, ghosts_db, tiny_db = answer["bounds_db"]
    assert half_db > 0.0
    assert ghosts_db > -20.0 > tiny_db
    assert tiny_db < half_db - 60.0


def test_broken_effects_are_left_out_with_a_line_each(tmp_path: Path) -> None:
    points = {
        "atmosphere": "fine",
        "broken": "broken",
        "empty": "empty",
        "both": "both",
        "bad-name": "fine",
        "spoken": "spoken",
        "working": "fine",
    }
    sources = {
        "fine": HALF,
        "broken": "oops",
        "empty": "ABOUT = 'nothing'",
        "both": HALF + "apply = factor",
        "spoken": HALF + "factor = 'twice'",
    }
    write_package(tmp_path, "acme", EFFECTS, points, **sources)
    answer, log = run(
        tmp_path,
        "from sim_player.effects.table import EFFECTS, SHIPPED\nprint(json.dumps(sorted(set(EFFECTS) - SHIPPED)))",
    )
    assert answer == ["working"]
    lines = sorted(line.removeprefix("effect ").removesuffix("; it is left out") for line in log)
    assert lines[0] == "atmosphere of acme 1.2: mirrorwave has an effect of this name"
    assert lines[1].startswith("bad-name of acme 1.2: a name must be of a-z")
    assert lines[2] == "both of acme 1.2: both must define apply(tracing) or factor(echoes, world, used), one of"
    assert lines[3].startswith("broken of acme 1.2: broken cannot be imported: NameError: name 'oops' is not defined (")
    assert lines[4] == "empty of acme 1.2: empty must define absent"
    assert lines[5] == "spoken of acme 1.2: factor of spoken must be a function"
    assert len(lines) == 6


def test_a_21st_effect_of_other_packages_is_left_out(tmp_path: Path) -> None:
    """Twelve path effects of ours leave 20 of 32 bits."""
    write_package(tmp_path, "acme", EFFECTS, {f"effect{number:02}": "fine" for number in range(21)}, fine=HALF)
    script = """
from sim_player.effects.table import EFFECTS, SHIPPED
from sim_player.trace.effect_names import bit
print(json.dumps([len(set(EFFECTS) - SHIPPED), bit("effect19")]))
"""
    assert run(tmp_path, script) == (
        [20, 1 << 31],
        ["effect effect20 of acme 1.2: there are 20 effects of other packages already; it is left out"],
    )


#: What an effect does wrong, by its name, and the line that says so.
WRONGS = {
    "worded": (HALF.replace("0.5 if", "'x' if"), "factor must return a number or one for each of"),
    "short": (HALF.replace("0.5 if", "[0.5, 0.5] if"), "factor must return a number or one for each of"),
    "unknown": (HALF.replace("0.5 if", "float('nan') if"), "factors must be finite"),
    "raising": (HALF.replace("0.5 if", "1 / 0 if"), "ZeroDivisionError: division by zero ("),
    "bitless": (GHOSTS.replace('bit("ghosts")', "0"), "echoes must carry bit('bitless') in needs"),
    "loud": (GHOSTS.replace("0.316 *", "float('inf') *"), "weights of echoes must be finite"),
    "listed": (GHOSTS.replace("return echoes", "return list(echoes.weight) or echoes"), "apply must return Echoes"),
    "misnamed": (GHOSTS.replace('bit("ghosts")', 'bit("ghost")'), "'ghost' is no path effect of mirrorwave, nor"),
}


def test_what_an_effect_does_wrong_is_said_with_its_package(tmp_path: Path) -> None:
    """One process loads them all and asks for each alone."""
    sources = {name: source.replace('"ghosts"', f'"{name}"') for name, (source, _) in WRONGS.items()}
    write_package(tmp_path, "acme", EFFECTS, {name: name for name in sources}, **sources)
    script = f"""{SCENE}
from sim_player.effects.table import SHIPPED
from sim_player.planner.plan import manual_plan
said = {{}}
for name in {list(WRONGS)!r}:
    try:
        manual_plan(world, scene.setup, SHIPPED | {{name}}).paths
    except ValueError as error:
        said[name] = str(error)
print(json.dumps(said))
"""
    said, log = run(tmp_path, script)
    assert log == []
    assert list(said) == list(WRONGS)
    for name, (_, line) in WRONGS.items():
        assert said[name].startswith(f"effect {name} of acme 1.2: "), name
        assert line in said[name], name
        assert "\n" not in said[name], name
