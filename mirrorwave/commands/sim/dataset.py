"""`mirrorwave sim dataset`: labelled data sets."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from mirrorwave.console import AsJson, Progress, print_result, progress_bar
from msgs.values.wording import counted, duration_text

if TYPE_CHECKING:
    from sim_player.dataset.shards import ShardDone


Places = Literal["any", "street", "parking_lot", "residential_block", "mixed_intersection"]
Executor = Literal["local", "ray", "slurm"]


def dataset(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder of the shards.")],
    count: Annotated[int, typer.Option(min=1, help="Scenes to simulate; with --scans drives.")],
    seed: int = 0,
    motion: Annotated[bool, typer.Option("--motion", hidden=True)] = False,
    scans: Annotated[
        int | None, typer.Option(metavar="N", help="Drives of N scans (1 to 100): radar and road users move.")
    ] = None,
    places: Annotated[Places, typer.Option(help="Type of place.")] = "any",
    preset: Annotated[Literal["xband", "77ghz"], typer.Option(help="Radar.")] = "xband",
    effects: Annotated[
        str | None,
        typer.Option(metavar="auto|all|basic|LIST", help="Default auto.", show_default=False),
    ] = None,
    budget_db: Annotated[float, typer.Option(help="What planned effects may leave out, in any cell.")] = -20.0,
    purpose: Annotated[
        Literal["samples", "peaks", "objects"] | None,
        typer.Option(
            "--for", help="What --effects auto keeps; default objects, what perception needs.", show_default=False
        ),
    ] = None,
    shift: Annotated[
        Literal["none", "hard"], typer.Option(help="hard: rougher walls, clutter, gain and phase errors, dead beams.")
    ] = "none",
    truth: Annotated[
        bool, typer.Option("--truth", help="All objects with their boxes in the facts; drives always have them.")
    ] = False,
    executor: Annotated[
        Executor, typer.Option(help="Processes here, a Ray cluster (RAY_ADDRESS), a Slurm job array.")
    ] = "local",
    workers: Annotated[int, typer.Option(min=1, help="Shards made at a time.")] = 1,
    slurm: Annotated[
        list[str] | None, typer.Option(metavar="KEY=VALUE", help="Slurm parameter (partition, timeout_min, ...).")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Labelled range profiles of random places; resumable, the same bytes for any executor and number of workers."""
    from sim_player.dataset.shards import Recipe
    from sim_player.dataset.writer import write_dataset

    if motion and scans is None:
        raise ValueError("--motion must come with --scans N, the scans of a drive, got none")
    recipe = Recipe(
        places=places,
        preset=preset,
        effects=parse_effects(effects),
        budget_db=budget_db,
        purpose=purpose,
        shift=shift,
        scans=scans,
        truth=truth,
    )
    with progress_bar("scenes", count * (scans or 1)) as progress:
        report = _Report(out, count * (scans or 1), progress)
        write_dataset(
            out,
            count,
            seed,
            recipe,
            workers=workers,
            on_shard=report.hear,
            executor=executor,
            slurm=parse_slurm(slurm or []),
        )
    print_result(as_json, report.summary() | {"series": recipe.described(seed)}, report.line())


def parse_effects(text: str | None) -> str | tuple[str, ...] | None:
    """`auto`, `all`, `basic`, or names with commas between them."""
    if text is None or text in ("auto", "all", "basic"):
        return text
    return tuple(sorted({name.strip() for name in text.split(",") if name.strip()}))


def parse_slurm(texts: list[str]) -> dict[str, Any]:
    """KEY=VALUE texts; a value that is a whole number becomes one."""
    parameters: dict[str, Any] = {}
    for text in texts:
        key, separator, value = text.partition("=")
        if not (key.isidentifier() and separator and value):
            raise ValueError(f"--slurm must be KEY=VALUE, got {text!r}")
        parameters[key] = int(value) if value.lstrip("-").isdigit() else value
    return parameters


class _Report:
    """Progress of a run, and its rate; rates count only what this run made."""

    def __init__(self, out: Path, count: int, progress: Progress) -> None:
        self.out, self.count, self.progress = out, count, progress
        self.scenes = {"kept": 0, "made": 0, "rewritten": 0}
        self.rewritten: list[dict[str, str]] = []
        self.start_s = time.perf_counter()

    def hear(self, shard: ShardDone) -> None:
        """One more shard."""
        self.scenes[shard.state] += shard.scenes
        if shard.state == "rewritten":
            self.rewritten.append({"shard": shard.shard, "reason": shard.reason})
            self.progress.print(f"mirrorwave: {self.out / shard.shard}: made again: {shard.reason}")
        (self.progress.keep if shard.state == "kept" else self.progress)(shard.scenes)

    @property
    def made(self) -> int:
        """Scenes simulated in this run."""
        return self.scenes["made"] + self.scenes["rewritten"]

    @property
    def seconds(self) -> float:
        """Time since the start."""
        return time.perf_counter() - self.start_s

    @property
    def rate(self) -> float:
        """Scenes a second."""
        return self.made / self.seconds

    def summary(self) -> dict[str, Any]:
        """Return the summary for scripts."""
        return {
            "folder": str(self.out),
            "scenes": self.count,
            "kept": self.scenes["kept"],
            "made": self.made,
            "rewritten": self.rewritten,
            "seconds": round(self.seconds, 3),
            "scenes_per_s": round(self.rate, 4),
        }

    def line(self) -> str:
        """The same for people."""
        kept = f", {self.scenes['kept']} there already" if self.scenes["kept"] else ""
        again = f", {counted(len(self.rewritten), 'shard')} made again" if self.rewritten else ""
        made = f"{counted(self.count, 'scene')} in {duration_text(self.seconds)}, {self.rate:.2f} a second"
        return f"{self.out}: {made}{kept}{again}"
