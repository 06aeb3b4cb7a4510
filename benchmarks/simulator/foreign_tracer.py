"""Our tracer beside a foreign one, Sionna RT, on drawn places: common, missing and extra paths, and their differences.

Both find the specular paths from the antenna to every scattering centre and back to the antenna itself, by two
reflections at most. Usage: DRJIT_LIBLLVM_PATH=/usr/lib/x86_64-linux-gnu/libLLVM.so.19.1
python -m benchmarks.simulator.foreign_tracer [--places 50] [--seed 21] [--samples 200000]
[--out docs/results/foreign-tracer.md]
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from collections.abc import Iterable
from functools import partial
from importlib.metadata import version
from pathlib import Path
from textwrap import fill

import numpy as np

from benchmarks.simulator.path_comparison import (
    UNEXPLAINED,
    Comparison,
    Place,
    Unmatched,
    compare,
    end_points,
    join_comparisons,
    our_routes,
)
from lab.foreign.export import ARC_ERROR_M, clear_of_bodies, exported_surfaces
from lab.foreign.sionna_tracer import SAMPLES, ForeignTracerMissingError, llvm_version, trace_to_points
from lab.studies.report import machine, versions
from mirrorwave.plots.markdown import table
from sim_player.generate.places import random_place
from sim_player.scene.description import Scene
from sim_player.scene.world import prepare, snapshot

LENGTH_AIM_M, AMPLITUDE_AIM_DB = 1e-4, 0.5

COMMON_GROUND = """\
Both tracers find all specular paths of one way, by two reflections at most: from the antenna to every scattering centre
and, as "own image", back to the antenna. Out and back by them make every echo of an object up to antenna - wall - wall
- object - wall - wall - antenna. `lab/foreign/` exports a scene as triangles and reads the foreign paths as
routes, from which our echoes and beats are made.

- Walls: both mirror upright sheets with the reflection of a slab; ours takes vertical polarisation as TE, the foreign
  tracer turns vectors. Amplitude and phase are compared where all walls of a path are flat and of one layer. A wall
  without a back is 10 m thick there.
- Materials: each tracer uses its own table of ITU-R P.2040; asphalt, which differs, has our permittivity in both.
- Arcs: ours has Fermat points and focusing, the export flat strips within 1 mm of the arc. Geometry alone is compared.
- Objects: ours has scattering centres and boxes that block, open above; the export has closed metal boxes, which mirror
  too. Centres stand 1 cm outside their box in both.
- Ground: a plane for ours, a square of 500 m in the export; ours takes vertical polarisation as TM.
- Left out of both: roughness, foliage, air, transmission, diffraction, ground with two walls (third order).

Ours computes in double precision; the foreign tracer searches surfaces by rays and computes in single precision. A path
of one tracer alone gets its reason by computation: the surfaces it meets, its distance from every edge, the triangles
or boxes in its way, the foreign search once more for it alone and from its other end. Level: field over the strongest
common path to the same point, one way.
"""


def compare_scene(scene: Scene, samples: int = SAMPLES) -> Comparison:
    """Compare both tracers on one scene at rest; `ForeignTracerMissingError` without the foreign one."""
    world = clear_of_bodies(prepare(scene))
    view, surfaces = snapshot(world), exported_surfaces(world)
    traced = partial(trace_to_points, surfaces, carrier_hz=world.radar.carrier_hz, samples=samples)
    place = Place(view, surfaces, our_routes(view), traced(source_m=view.antenna, point_m=end_points(view)))
    return compare(place, lambda source_m, point_m: traced(source_m=source_m, point_m=point_m[None]))


def page(result: Comparison, command: str, places: int, samples: int) -> str:
    """Return the results as Markdown."""
    stated = ", ".join(f"{name} {number}" for name, number in {**versions(), **foreign_versions()}.items())
    run = f"`{command}`: {places} drawn places, {samples} search rays. {machine()}; {stated}. Written by the command."
    errors = ("path", "length, um", "departure, urad", "arrival, urad", "amplitude, dB", "phase, deg")
    lines = [
        *("# A foreign tracer", "", fill(run, 120), "", COMMON_GROUND),
        *("## Common, missing, extra", ""),
        *table(("path", "common", "missing in the foreign", "extra in the foreign"), _counts(result)),
        *("", fill(_aims(result), 120), ""),
        *("## Differences of common paths", "", "Median, 99 % quantile and largest magnitude.", ""),
        *table(errors, _errors(result)),
        *("", "## Missing in the foreign tracer", "", *_reasons(result.missing)),
        *("", "## Extra in the foreign tracer", "", *_reasons(result.extra), ""),
    ]
    return "\n".join(lines)


def _aims(result: Comparison) -> str:
    """Return how many common paths miss the aims, and how many others have no reason."""
    by_arc = np.char.endswith(result.group, "arc")
    wide = np.abs(result.length_m) > LENGTH_AIM_M
    levels_db = np.abs(result.amplitude_db[np.isfinite(result.amplitude_db)])
    odd = sum(path.reason == UNEXPLAINED for path in (*result.missing, *result.extra))
    return (
        f"Common paths whose lengths differ by more than {LENGTH_AIM_M:g} m: {(wide & ~by_arc).sum()} of "
        f"{(~by_arc).sum()} by flat surfaces, {(wide & by_arc).sum()} of {by_arc.sum()} by arcs (their strips lie off "
        f"by up to {1e3 * ARC_ERROR_M:g} mm). Compared amplitudes that differ by more than {AMPLITUDE_AIM_DB:g} dB: "
        f"{(levels_db > AMPLITUDE_AIM_DB).sum()} of {len(levels_db)}. Paths without a reason: {odd}."
    )


def foreign_versions() -> dict[str, str]:
    """Return the versions of the foreign tracer and of what it compiles with."""
    return {"sionna-rt": version("sionna-rt"), "drjit": version("drjit"), "LLVM": llvm_version()}


def _own_last(name: str) -> tuple[bool, str]:
    return name.startswith("own"), name


def _groups(result: Comparison) -> list[str]:
    unmatched = [path.group for path in (*result.missing, *result.extra)]
    return sorted({*result.group.tolist(), *unmatched}, key=_own_last)


def _counts(result: Comparison) -> Iterable[tuple[str, ...]]:
    for group in _groups(result):
        alone = (sum(path.group == group for path in paths) for paths in (result.missing, result.extra))
        yield group, str(int((result.group == group).sum())), *map(str, alone)
    yield "all", str(len(result.group)), str(len(result.missing)), str(len(result.extra))


def _errors(result: Comparison) -> Iterable[tuple[str, ...]]:
    for group in sorted(set(result.group.tolist()), key=_own_last):
        here = result.group == group
        columns = (
            1e6 * result.length_m,
            1e6 * result.depart_rad,
            1e6 * result.arrive_rad,
            result.amplitude_db,
            np.degrees(result.phase_rad),
        )
        yield group, *(_quantiles(np.abs(column[here])) for column in columns)


def _quantiles(values: np.ndarray) -> str:
    values = values[np.isfinite(values)]
    return " / ".join(f"{np.quantile(values, share):.2g}" for share in (0.5, 0.99, 1.0)) if len(values) else "-"


def _reasons(paths: tuple[Unmatched, ...]) -> list[str]:
    """Return the table of unmatched paths by kind and reason."""
    levels: dict[tuple[str, str], list[float]] = defaultdict(list)
    for path in paths:
        levels[path.group, path.reason].append(path.level_db)
    rows = (
        (group, reason, str(len(level_db)), _level(np.array(level_db)), str(int(np.isinf(level_db).sum())))
        for (group, reason), level_db in sorted(levels.items(), key=lambda item: (_own_last(item[0][0]), item[0]))
    )
    return table(("path", "reason", "paths", "level, dB: median, largest", "to points without a common path"), rows)


def _level(level_db: np.ndarray) -> str:
    level_db = level_db[np.isfinite(level_db)]
    return f"{np.median(level_db):.1f}, {level_db.max():.1f}" if len(level_db) else "-"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--places", type=int, default=50)
    parser.add_argument("--seed", type=int, default=21)
    parser.add_argument("--samples", type=int, default=SAMPLES)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    try:
        parts = [
            compare_scene(random_place(arguments.seed, index), arguments.samples) for index in range(arguments.places)
        ]
    except ForeignTracerMissingError as error:
        sys.exit(f"foreign_tracer: {error}")
    command = f"python -m benchmarks.simulator.foreign_tracer --places {arguments.places} --seed {arguments.seed}"
    text = page(join_comparisons(parts), command, arguments.places, arguments.samples)
    if arguments.out:
        arguments.out.write_text(text, encoding="utf-8")
    else:
        print(text)


if __name__ == "__main__":
    main()
