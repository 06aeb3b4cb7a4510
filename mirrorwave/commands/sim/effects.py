"""`mirrorwave sim effects` and `sim paths`: what a scene calls for, and every way its echoes take."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from mirrorwave.completion import complete_scenes
from mirrorwave.console import AsJson, print_json, print_line, print_table, progress_bar
from msgs.values.wording import counted

if TYPE_CHECKING:
    from sim_player.lidar.spad import OpticPlan
    from sim_player.planner.plan import Plan

SceneFile = Annotated[Path, typer.Argument(metavar="SCENE", help="Scene file (YAML).", autocompletion=complete_scenes)]
Budget = Annotated[
    float, typer.Option("--budget-db", help="Most that any cell may be off, relative to noise or what stands there.")
]
Effects = Annotated[
    str, typer.Option("--effects", help="auto (what the scene calls for), all, basic, or names with commas between.")
]
#: Purposes as `sim_player.planner.purposes` has them.
For = Annotated[
    Literal["samples", "peaks", "objects"],
    typer.Option(
        "--for", help="What --effects auto keeps: every sample, detected peaks, what detectors tell from noise."
    ),
]


def effects(
    scene: SceneFile,
    budget_db: Budget = -20.0,
    choice: Effects = "auto",
    purpose: For = "samples",
    seed: int = 0,
    plot: Annotated[
        Path | None, typer.Option(help="Picture: maps with all effects and as planned, their difference, the time.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Show the effects that a scene needs, what each could change, and why it is used or skipped.

    As `sim run`, `sim dataset` and the player use them, with the same --for and --budget-db.
    """
    import msgspec

    from sim_player.effects.table import ALL_EFFECTS
    from sim_player.lidar.spad import plan_optics
    from sim_player.paths.ray_tracing import BASIC_EFFECTS
    from sim_player.planner.levels import levels_of
    from sim_player.planner.plan import manual_plan, plan_world, resolve_plan
    from sim_player.planner.purposes import purpose_of
    from sim_player.scene.description import load_scene
    from sim_player.scene.world import prepare

    loaded = load_scene(scene)
    with progress_bar("walls and objects"):
        world = prepare(loaded, seed)
    if loaded.radar.preset == "spad":
        if (budget_db, choice, purpose) != (-20.0, "auto", "samples"):
            raise ValueError(
                f"{scene}: --effects, --for and --budget-db must stay at their defaults, radar.preset is 'spad'"
            )
        if plot is not None:
            raise ValueError(f"{scene}: --plot draws maps of radars, radar.preset is 'spad'")
        _print_light_plan(plan_optics(world, loaded.lidar), as_json)
        return
    with progress_bar("tracing and planning"):
        if choice == "auto":
            plan = plan_world(world, loaded.setup, budget_db, thorough=True, purpose=purpose_of(purpose))
        else:
            resolved = resolve_plan(world, loaded.setup, choice, budget_db)
            plan = resolved or manual_plan(world, loaded.setup, (BASIC_EFFECTS | _PLAIN_SIGNAL) & ALL_EFFECTS)
        if plot is not None:
            from mirrorwave.plots.plan import write_plan

            write_plan(plot, plan, seed)
    if as_json:
        rows = msgspec.to_builtins(plan.effects)
        answer = {"purpose": plan.purpose.value, "budget_db": plan.budget_db, "effects": rows}
        levels = msgspec.to_builtins(levels_of(plan))
        print_json({**answer, "paths": len(plan.echoes), "traced": plan.traced, "levels": levels})
        return
    _print_plan(plan, loaded.name)
    if plot is not None:
        print_line(f"picture: {plot}")


#: What the plain signal chain has.
_PLAIN_SIGNAL = frozenset({"motion", "element_pattern", "quantised_phases", "thermal_noise", "adc"})


def _print_light_plan(plans: Sequence[OpticPlan], as_json: bool) -> None:
    """Print the light that reaches a LiDAR, and how its photons are counted."""
    import msgspec

    if as_json:
        print_json({"contributions": msgspec.to_builtins(plans)})
        return
    rows = [(plan.name, "used" if plan.used else "skipped", f"{plan.bound:.3g}", plan.reason) for plan in plans]
    print_table(("contribution", "", "detections", "why"), rows)


def _print_plan(plan: Plan, name: str) -> None:
    """Print one row for each effect and level, and a line of sums."""
    from sim_player.planner.levels import levels_of

    rows = [
        (
            effect.name,
            "used" if effect.used else "skipped",
            ("-" if effect.bound_db is None else f"{effect.bound_db:.0f}"),
            f"{1e3 * effect.cost_s:.1f}",
            f"{plan.share_of(effect):.0f}",
            effect.reason,
        )
        for effect in plan.effects
    ]
    rows += [(level.part, level.choice, "-", "-", "-", level.reason) for level in levels_of(plan)]
    print_table(("effect", "", "bound dB", "cost ms", "share %", "why"), rows)
    if not len(plan.echoes):
        typer.echo(f"{name}: no echo reaches the radar, its map holds noise alone", err=True)
    effects = f"{sum(e.used for e in plan.effects)} of {counted(len(plan.effects), 'effect')}"
    share = f", {sum(map(plan.share_of, plan.effects)):.0f} % of the signal's time"
    used = f"{effects}, {len(plan.echoes)} of {counted(plan.traced, 'path')}{share}"
    if math.isinf(plan.budget_db):
        print_line(f"{name}: {used}; chosen by hand, nothing bounded")
        return
    if plan.view.world.scene.moves:
        paths = ", nor a path" if plan.weakest is None else "; each beam leaves out its weakest paths"
        print_line(f"{name}: {used}; no effect that the moving scene has is left out{paths}")
        return
    spent = "nothing" if plan.spent_db is None else f"{plan.spent_db:.0f} dB"
    budget = f"for {plan.purpose}, budget {plan.budget_db:g} dB"
    print_line(f"{name}: {used}; what was left out changes {spent} at most ({budget})")


def paths(
    scene: SceneFile,
    budget_db: Budget = -20.0,
    choice: Effects = "all",
    purpose: For = "samples",
    seed: int = 0,
    hidden_only: Annotated[
        bool, typer.Option("--hidden-only", help="Only echoes of objects that mirrors show and direct sight does not.")
    ] = False,
    kind: Annotated[
        Literal["los", "mnlos"] | None, typer.Option(help="Only direct echoes (los), or mirrored ones (mnlos).")
    ] = None,
    strongest: Annotated[
        int | None, typer.Option("--top", "--strongest", metavar="N", min=1, help="Only the N strongest of them.")
    ] = None,
    plot: Annotated[Path | None, typer.Option(help="Picture of the ways (PNG).")] = None,
    as_json: AsJson = False,
) -> None:
    """Every echo the tracer finds: its way, length, direction and weight."""
    from mirrorwave.diagnose.echo_paths import PathFilter, PlanChoice, echo_paths, path_line, path_row
    from sim_player.scene.description import load_scene

    loaded = load_scene(scene)
    if loaded.radar.preset == "spad":
        raise ValueError(f"{scene}: radar.preset: must be a radar, xband or 77ghz, got {loaded.radar.preset!r}")
    wanted = PathFilter(hidden_only, kind, strongest)
    with progress_bar("tracing"):
        traced, power_mw, polylines = echo_paths(loaded, seed, PlanChoice(choice, budget_db, purpose), wanted)
    if plot is not None:
        from mirrorwave.plots.scene import draw_paths

        draw_paths(plot, loaded, traced, polylines, power_mw)
    if as_json:
        print_json([path_row(traced, index, polylines[index]) for index in range(len(traced))])
        return
    rows = [path_line(traced, index, float(power_mw[index])) for index in range(min(len(traced), 40))]
    print_table(
        ("kind", "order", "length m", "azimuth deg", "dBm", "object", "surface", "by way of"), rows, ("surface",)
    )
    more = f", the strongest {len(rows)} shown" if len(traced) > len(rows) else ""
    print_line(f"{loaded.name}: {counted(len(traced), 'path')}{more}{'' if plot is None else f'; picture: {plot}'}")
