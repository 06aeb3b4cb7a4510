"""The networks of the specification at full size, and our detector, from data drawn on the machine that trains them.

One GPU, many cores, no network, some minutes: places are drawn by as many processes as there are cores, their maps
formed as they come, and trained on while more are drawn. Our detector ends with the drawing and is exported at once;
UNet and both sizes of Swin-UNet train all the time, the other networks after the drawing, and last the runs of the
curve against the number of training maps. The clock starts when the simulator is compiled. Whatever `--work` holds is
kept: the same command goes on where it was stopped.
Usage: python -m benchmarks.accuracy.full_size --work DIR --out DIR [--minutes 6.5] [--places 20000] [--workers 16]
       python -m benchmarks.accuracy.full_size --unpack DIR --out runs/full_size
The second writes what the first left in its --out as run folders for `mirrorwave export`.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.accuracy.kernels_ahead import compile_ahead
from lab.training.data.frames import DataSet, fixed_splits
from lab.training.data.map_arrays import ArrayMaker, MapArrays, View
from lab.training.data.samples import DataConfig
from models.perception.find.onnx_model import DEFAULT_MODEL
from msgs.files.checksums import json_lines
from msgs.files.whole_files import write_whole

MIRRORWAVE = (sys.executable, "-m", "mirrorwave.cli")
#: Chosen and reported on: its validation and test splits. Its training split trains beside the places drawn further.
REPORTING, REPORTING_COUNT = "places_v1", 2160
FURTHER = "places_further"
RECIPE = ("--effects", "all", "--truth")
SPLITS = ("train", "validation", "test")
#: Maps of all ranges, and what our detector sees of them.
FULL_VIEW, DETECTOR_VIEW = View(512, 256), View(320, 32)
#: As recorded, and by another radar.
VARIANTS = 2
MAKERS = 2
#: Scenes before the first step.
FEWEST_SCENES = 40
#: Of the minutes: drawing, with our detector; after it the compact networks; the curve has the rest.
DRAWING_SHARE, COMPACT_SHARE = 0.48, 0.30
#: Left at the end for scores and packing, and before it for those of a detector.
CLOSING_SHARE = 0.09
#: A run of less is a trial of every step.
SMOKE_MINUTES = 3.0
DETECTOR = "compact_unet"
#: Tells the processes of a run when it began.
STARTED = "MIRRORWAVE_FULL_SIZE_STARTED_S"
RESULTS = "full_size.json"


@dataclass(frozen=True, kw_only=True)
class Job:
    """A training: its network and settings, the phase it starts in (0: at once) and the one it ends with."""

    name: str
    network: str
    batch_size: int
    learning_rate: float
    starts: int
    ends: int
    bits: str = "fp16"
    #: Trains on the first so many scenes alone; 0: all.
    limit: int = 0


JOBS = (
    Job(name=DETECTOR, network="compact_unet:compact", batch_size=32, learning_rate=3e-3, starts=0, ends=0,
        bits="fp32"),
    Job(name="swin_unet_full", network="swin_unet:full", batch_size=32, learning_rate=4e-4, starts=0, ends=2,
        bits="int8"),
    Job(name="swin_unet", network="swin_unet:compact", batch_size=64, learning_rate=2e-3, starts=0, ends=2),
    Job(name="unet", network="unet:compact", batch_size=64, learning_rate=4e-3, starts=0, ends=2),
    Job(name="further_than_cfar", network="further_than_cfar:compact", batch_size=32, learning_rate=3e-3, starts=1,
        ends=1),
    Job(name="rtn", network="radar_tensor_network:compact", batch_size=32, learning_rate=3e-3, starts=1, ends=1),
)  # fmt: skip
CURVE = tuple(
    replace(job, name=f"{job.name}_{limit}", starts=2, ends=2, limit=limit)
    for job in JOBS
    if job.name in ("unet", "swin_unet", DETECTOR)
    for limit in (250, 1000, 4000)
)


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What every process of a run knows."""

    work: Path
    #: Ends of the phases, of `time.monotonic`, and of everything.
    phases_s: tuple[float, float, float]
    ends_s: float
    seed: int
    command: str
    #: Minutes of each phase.
    minutes: tuple[float, float, float]
    #: Networks with fewer channels, for tests.
    tiny: bool = False
    #: Every state is read back before it is scored, as a later run would read it.
    reads_back: bool = False

    @property
    def detector(self) -> Path:
        """File of our detector."""
        return self.work / f"{DETECTOR}.onnx"

    @property
    def arrays(self) -> Path:
        """Folder of the arrays, one folder each for the splits and the further places."""
        return self.work / "arrays"

    def run_dir(self, job: Job) -> Path:
        """Folder of a run."""
        return self.work / "runs" / job.name


def say(words: str) -> None:
    """Print a line with its time."""
    started_s = float(os.environ.setdefault(STARTED, str(time.monotonic())))
    print(f"[{time.monotonic() - started_s:7.1f} s] {words}", flush=True)


def main(argv: Sequence[str] | None = None) -> None:
    options = _options(argv)
    if options.unpack is not None:
        unpack(options.unpack, options.out)
        return
    os.environ[STARTED] = str(time.monotonic())
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ[name] = "1"
    options.work.mkdir(parents=True, exist_ok=True)
    options.out.mkdir(parents=True, exist_ok=True)
    os.environ.setdefault("NUMBA_CACHE_DIR", str((options.work / "kernels").resolve()))
    say(f"{compile_ahead(options.workers)} kernels compiled")
    _compile(options.work / "first_places")
    say("first places simulated")
    _Run(options).run()


def _options(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path("runs/full_size"))
    parser.add_argument("--out", type=Path, default=Path("runs/full_size/results"))
    parser.add_argument("--minutes", type=float, default=6.5, help="of drawing and training")
    parser.add_argument("--places", type=int, default=20_000, help="at most so many further places")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes that draw")
    parser.add_argument("--seed", type=int, default=6100, help="of the further places")
    parser.add_argument("--no-curve", action="store_true")
    parser.add_argument(
        "--only", nargs="*", default=[], choices=[job.name for job in JOBS], help="these networks alone"
    )
    parser.add_argument("--tiny", action="store_true", help="networks of a few channels, for tests")
    parser.add_argument(
        "--then",
        default="",
        metavar="COMMAND",
        help="shell command to run once our detector is exported; in its words {places} {reporting} {detector} {out} "
        "{seconds} are the folders of shards, the network file, --out, and the seconds that are left",
    )
    parser.add_argument("--unpack", type=Path, metavar="DIR", help="write the results in DIR as run folders to --out")
    return parser.parse_args(argv)


def _compile(folder: Path) -> None:
    """Simulate a place of each recipe, so that the processes find every kernel compiled."""
    commands = [
        ("--count", "1", "--seed", "1", *RECIPE, "--out", str(folder / "all")),
        ("--count", "1", "--seed", "1", "--out", str(folder / "auto")),
    ]
    running = [
        subprocess.Popen((*MIRRORWAVE, "sim", "dataset", *command), stdout=subprocess.DEVNULL) for command in commands
    ]
    for process in running:
        if process.wait() != 0:
            sys.exit("the first place must be simulated without an error, which is above")
    views, data = (FULL_VIEW, DETECTOR_VIEW), DataSet(folder / "all")
    ArrayMaker(DataConfig(), views, VARIANTS, data.setup).make(folder / "all" / "shard-00000.npz", folder / "arrays")


class _Run:
    """The parts of a run: drawing, arrays, trainings, the further command, results."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options, start_s = options, time.monotonic()
        shares = [DRAWING_SHARE, COMPACT_SHARE, 1.0 - CLOSING_SHARE - DRAWING_SHARE - COMPACT_SHARE]
        if options.no_curve:
            shares[1:] = [sum(shares[1:]), 0.0]
        minutes = [options.minutes * share for share in shares]
        ends_s = start_s + 60.0 * np.cumsum(minutes)
        self.plan = Plan(
            work=options.work.resolve(),
            phases_s=(float(ends_s[0]), float(ends_s[1]), float(ends_s[2])),
            ends_s=start_s + 60.0 * options.minutes,
            seed=options.seed,
            # without the folders of one machine
            command=f"python -m benchmarks.accuracy.full_size --minutes {options.minutes:g} --places {options.places} "
            f"--seed {options.seed}{' --no-curve' if options.no_curve else ''}"
            f"{' '.join(['', '--only', *options.only]) if options.only else ''}",
            minutes=(minutes[0], minutes[1], minutes[2]),
            tiny=options.tiny,
            reads_back=options.minutes <= SMOKE_MINUTES,
        )
        self.context = multiprocessing.get_context("spawn")
        self.drawn = self.context.Event()
        self.processes: list[tuple[str, BaseProcess]] = []
        self.draws: dict[str, subprocess.Popen[bytes]] = {}
        self.then: subprocess.Popen[bytes] | None = None
        self.jobs = [job for job in JOBS if not options.only or job.name in options.only]
        if not options.no_curve:
            self.jobs += [job for job in CURVE if not options.only or job.name.rsplit("_", 1)[0] in options.only]

    def run(self) -> None:
        try:
            self._start_drawing()
            for rank in range(MAKERS):
                self._start(f"maker {rank}", _make_arrays, (self.plan, self.drawn, rank))
            self._train_phase(0)
            self._wait_until(self.plan.phases_s[0], self._watch_drawing)
            self._stop_drawing()
            self._train_phase(1)
            self._start_further()
            self._wait_until(self.plan.phases_s[1])
            self._train_phase(2)
            self._wait_for_all(self.plan.ends_s + 60.0)
            write_results(self.plan, self.jobs, self.options.out)
            self._end_further()
        finally:
            self._end()

    def _start(self, name: str, target: Callable[..., None], arguments: tuple[Any, ...]) -> None:
        process = self.context.Process(target=_apart, args=(target, arguments), name=name)
        process.start()
        self.processes.append((name, process))

    def _start_drawing(self) -> None:
        options, work = self.options, self.plan.work
        reporting = min(REPORTING_COUNT, options.places)
        series = {
            REPORTING: ("--count", str(reporting), "--seed", "7", "--workers", str(max(options.workers // 3, 1))),
            FURTHER: ("--count", str(options.places), "--seed", str(options.seed), *RECIPE,
                      "--workers", str(options.workers)),
        }  # fmt: skip
        for name, words in series.items():
            # the last shards of an earlier run that was to draw more stay
            self.draws[name] = subprocess.Popen(
                ("nice", "-n", "5" if name == REPORTING else "10", *MIRRORWAVE, "sim", "dataset", *words,
                 "--out", str(work / name)),
                stdout=subprocess.DEVNULL, stderr=(work / f"{name}.log").open("ab"),
            )  # fmt: skip

    def _watch_drawing(self) -> None:
        reporting = self.plan.work / REPORTING
        if REPORTING in self.draws and self.draws[REPORTING].poll() is not None:
            self._require_done(REPORTING)
            fixed_splits(reporting)
            say(f"{REPORTING} drawn and split")

    def _require_done(self, name: str) -> None:
        if self.draws.pop(name).wait() != 0:
            log = (self.plan.work / f"{name}.log").read_text(errors="replace")
            sys.exit(f"{name}: drawing must end without an error, its last words: {log[-600:]}")

    def _stop_drawing(self) -> None:
        """Let the reporting places be finished, and stop the further ones: their whole shards count."""
        while REPORTING in self.draws:
            self._watch_drawing()
            time.sleep(0.2)
        process = self.draws.pop(FURTHER)
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(5.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self.drawn.set()
        shards = list((self.plan.work / FURTHER).glob("shard-*.npz"))
        say(f"drawing ended: {len(shards)} shards")
        if not shards:
            sys.exit(
                f"{FURTHER}: at least one shard must be drawn in {60 * self.options.minutes * DRAWING_SHARE:.0f} s"
            )

    def _train_phase(self, phase: int) -> None:
        for job in self.jobs:
            if job.starts == phase:
                self._start(job.name, _train, (self.plan, job))

    def _wait_until(self, until_s: float, watch: Callable[[], None] = lambda: None) -> None:
        while time.monotonic() < until_s and not self._nothing_left():
            watch()
            self._refuse_failures()
            time.sleep(0.2)

    def _nothing_left(self) -> bool:
        """Return whether nothing draws or trains that a phase would have to wait for."""
        drawing = any(process.poll() is None for process in self.draws.values())
        return not drawing and not self.draws and not any(process.is_alive() for _, process in self.processes)

    def _wait_for_all(self, until_s: float) -> None:
        for name, process in self.processes:
            process.join(max(until_s - time.monotonic(), 0.1))
            if process.is_alive():
                say(f"{name}: not done in time, left out")
        self._refuse_failures()

    def _refuse_failures(self) -> None:
        """Say which processes failed, once; the others go on, but not without arrays."""
        for entry in list(self.processes):
            name, process = entry
            if process.exitcode not in (None, 0):
                self.processes.remove(entry)
                say(f"{name}: FAILED with {process.exitcode}")
                if name.startswith("maker"):
                    sys.exit(f"{name} must not fail, its error is above")

    def _start_further(self) -> None:
        if not self.options.then:
            return
        detector, trains = self.plan.detector, [one for name, one in self.processes if name == DETECTOR]
        while not detector.exists() and any(process.is_alive() for process in trains):
            time.sleep(0.1)
        if not detector.exists():
            say("no detector was exported: the further command gets the shipped one")
            detector = DEFAULT_MODEL
        words = {
            "places": self.plan.work / FURTHER,
            "reporting": self.plan.work / REPORTING,
            "detector": detector,
            "out": self.options.out.resolve(),
            "seconds": round(self.plan.ends_s - time.monotonic()),
        }
        command = self.options.then
        for name, value in words.items():
            command = command.replace("{" + name + "}", str(value))
        say(f"then: {command}")
        self.then = subprocess.Popen(command, shell=True)

    def _end_further(self) -> None:
        if self.then is not None:
            say("waiting for the further command")
            say(f"further command ended with {self.then.wait()}")

    def _end(self) -> None:
        for process in self.draws.values():
            if process.poll() is None:
                process.terminate()
        for _, process in self.processes:
            if process.is_alive():
                process.terminate()


def _apart(target: Callable[..., None], arguments: tuple[Any, ...]) -> None:
    """Run a function in a process that leaves the terminal's interrupt to its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    target(*arguments)


def _make_arrays(plan: Plan, drawn: Any, rank: int) -> None:
    """Make the arrays of every shard as it comes, those of the reporting places by split: one process of `MAKERS`."""
    folder, maker, made, spent_s = plan.work / FURTHER, None, 0, 0.0
    while True:
        was_drawn = drawn.is_set()
        if maker is None:
            if not list(folder.glob("shard-*.npz")):
                time.sleep(0.2)
                continue
            maker = ArrayMaker(DataConfig(), (FULL_VIEW, DETECTOR_VIEW), VARIANTS, DataSet(folder).setup)
        found = _missing(plan, maker, rank)
        if not found and was_drawn:
            break
        for shard, out, scenes in found:
            start_s = time.monotonic()
            made += maker.make(shard, out, scenes)
            spent_s += time.monotonic() - start_s
        if not found:
            time.sleep(0.2)
    say(f"maker {rank}: {made} scenes, {1e3 * spent_s / max(made, 1):.1f} ms each")


def _missing(plan: Plan, maker: ArrayMaker, rank: int) -> list[tuple[Path, Path, list[int] | None]]:
    """Return this process's next shards without arrays, their folders and scenes (None: all)."""
    reporting, found = plan.work / REPORTING, list[tuple[Path, Path, list[int] | None]]()
    if (reporting / "splits.json").exists():
        splits, first = json.loads((reporting / "splits.json").read_bytes()), 0
        of_split = {split: set(splits[split]) for split in SPLITS}
        counts = {line["shard"]: line["scenes"] for line in map(json.loads, (reporting / "manifest.jsonl").open())}
        for shard in sorted(counts):
            for split in SPLITS:
                scenes = [index for index in range(counts[shard]) if first + index in of_split[split]]
                found += [(reporting / shard, plan.arrays / f"{REPORTING}_{split}", scenes)] if scenes else []
            first += counts[shard]
    found += [(shard, plan.arrays / FURTHER, None) for shard in sorted((plan.work / FURTHER).glob("shard-*.npz"))]
    mine = [one for one in found if int(one[0].stem.split("-")[-1]) % MAKERS == rank]
    return [one for one in mine if not maker.is_made(one[0], one[1])][:4]


def _train(plan: Plan, job: Job) -> None:
    """Train, score and export one network: a process of its own."""
    import torch

    torch.set_num_threads(1)
    torch.set_float32_matmul_precision("high")
    torch.backends.cudnn.benchmark = True
    train(plan, job)


def train(plan: Plan, job: Job) -> None:
    """Train, score and export one network with the arrays in the plan's folder; what is done is left."""
    import torch

    from lab.training.export.onnx import export_scored
    from lab.training.run_folder import save_state
    from lab.training.timed.packed_runs import PACKED, packed, unpacked
    from lab.training.timed.training import TimedTraining, best_threshold

    start_s = time.monotonic()
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    run_dir, ends_s = plan.run_dir(job), plan.phases_s[job.ends]
    if (run_dir / "result.json").exists():
        say(f"{job.name}: done before")
        return
    config = run_config(plan, job, device.type == "cuda")
    encoding = config.data.encoding
    view = DETECTOR_VIEW if View.of(encoding) == DETECTOR_VIEW else FULL_VIEW

    def arrays(*names: str) -> MapArrays:
        return MapArrays([plan.arrays / name for name in names], view, encoding.range_bins)

    train = arrays(f"{REPORTING}_train", FURTHER)
    training = TimedTraining(config, train, run_dir, device, job.limit)
    ready_s = time.monotonic() - start_s
    while len(train) < FEWEST_SCENES and time.monotonic() < ends_s:
        time.sleep(0.2)
        train.refresh()
    if not len(train):
        say(f"{job.name}: no scenes in time")
        return
    say(f"{job.name}: starts on {device.type} with {len(train)} scenes, ready in {ready_s:.1f} s")
    if not training.is_done:
        training.run(ends_s, lambda words: say(f"{job.name}: {words}"))
    if plan.reads_back:
        losses = training.losses
        training.save()
        training = TimedTraining(config, train, run_dir, device, job.limit)
        training.losses = losses
    trained_s = training.progress.elapsed_s
    say(f"{job.name}: trained, {training.progress.steps} steps in {trained_s:.1f} s; scoring")
    validation, test = arrays(f"{REPORTING}_validation"), arrays(f"{REPORTING}_test")
    while job.name == DETECTOR and not _is_complete(plan, validation, test):
        time.sleep(0.2)
        validation.refresh()
        test.refresh()
    summary, tally = training.finish(validation, np.arange(len(validation)))
    if job.name == DETECTOR:
        export_scored(run_dir, plan.detector, tally)
        say(f"{job.name}: exported")
    small = packed(training.network.state_dict(), job.bits)  # type: ignore[arg-type]
    save_state(run_dir / PACKED, {"network": small, "epoch": summary.best.epoch})
    training.network.load_state_dict(unpacked(small))
    threshold = best_threshold(tally)
    _, tested = training.score(training.network, test, np.arange(len(test)))
    counts = list(tested.counts[threshold].values())
    result = {
        "network": job.network,
        "device": torch.cuda.get_device_name() if device.type == "cuda" else "cpu",
        "bits": job.bits,
        "scenes": training.scenes,
        "batch_size": job.batch_size,
        "learning_rate": job.learning_rate,
        "minutes": round(trained_s / 60.0, 3),
        "samples": training.samples,
        "samples_a_second": round(training.samples / max(trained_s, 1e-3), 1),
        "parameters": summary.parameters,
        "validation": round(summary.best.best_macro_f1, 4),
        "threshold": threshold,
        "test_scenes": len(test),
        "test": {
            "macro_f1": round(tested.macro_f1(threshold), 4),
            "los_f1": round(counts[0].f1, 4),
            "mirrored_f1": round(counts[1].f1, 4),
        },
        "curve": [asdict(report) for report in training.reports],
    }
    write_whole(run_dir / "result.json", json_lines(result))
    say(f"{job.name}: scored, test Macro-F1 {result['test']['macro_f1']}; {time.monotonic() - start_s:.1f} s in all")


def write_results(plan: Plan, jobs: Sequence[Job], out: Path) -> None:
    """Pack what has been trained to `out`, and write and print the figures."""
    from lab.training.timed.packed_runs import write_parts

    done = [job for job in jobs if (plan.run_dir(job) / "result.json").exists()]
    results = {job.name: json.loads((plan.run_dir(job) / "result.json").read_bytes()) for job in done}
    shipped = [plan.run_dir(job) for job in done if not job.limit]
    if shipped:
        parts = write_parts(shipped, out)
        say(f"{len(parts)} parts, {sum(path.stat().st_size for path in parts) / 2**20:.1f} MiB")
    content = {
        "command": plan.command,
        "further_places": len(MapArrays([plan.arrays / FURTHER], DETECTOR_VIEW)),
        "test_sha256": json.loads((plan.work / REPORTING / "splits.json").read_bytes())["test_sha256"],
        "runs": results,
    }
    write_whole(out / RESULTS, json_lines(content))
    for name, one in results.items():
        say(
            f"{name:24s} {one['scenes']:6d} maps {one['samples']:7d} samples {one['samples_a_second']:7.0f}/s  "
            f"test Macro-F1 {one['test']['macro_f1']:.3f} (LOS {one['test']['los_f1']:.3f}, "
            f"mirrored {one['test']['mirrored_f1']:.3f}) at {one['threshold']}"
        )


def _is_complete(plan: Plan, *splits: MapArrays) -> bool:
    """Return whether the arrays of validation and test scenes are all there."""
    path = plan.work / REPORTING / "splits.json"
    if not path.exists():
        return False
    named = json.loads(path.read_bytes())
    return [len(arrays) for arrays in splits] == [len(named["validation"]), len(named["test"])]


def run_config(plan: Plan, job: Job, on_gpu: bool) -> Any:
    """Return the configuration of a run as its folder and the card state it, alike whenever the command is given."""
    from lab.training.map_networks import FAMILIES, choice_of, preset_network
    from lab.training.schedules import ScheduleConfig
    from lab.training.train_dense import RunConfig, TrainDenseConfig

    family, size = job.network.split(":")
    choice, encoding = preset_network(family, size)
    if plan.tiny:
        choice = choice_of(family, tiny(choice.resolved))
    schedule = ScheduleConfig(
        batch_size=4 if plan.tiny else job.batch_size,
        learning_rate=job.learning_rate,
        # section 3.3 has none
        weight_decay=1e-3 if family == DETECTOR else 0.0,
        epochs=1,
        minutes=round(max(sum(plan.minutes[job.starts : job.ends + 1]), 0.01), 3),
    )
    training = TrainDenseConfig(
        network=choice, objective=FAMILIES[family].objective, schedule=schedule, mixed_precision=on_gpu
    )
    data = DataConfig(
        directory=f"data/{REPORTING}", more=(f"data/{FURTHER}",), limit=job.limit, encoding=encoding, clean_share=0.5
    )
    return RunConfig(training=training, data=data, command=plan.command)


def tiny(config: Any) -> Any:
    """Return a network's configuration with the fewest channels."""
    widths = {"compact_unet": (4, 4, 4, 8), "unet": (4, 4, 4, 4, 4)}
    if hasattr(config, "embed"):
        return replace(config, embed=8, heads=(1, 1, 1, 1), depths=(1, 1, 1, 1))
    if hasattr(config, "attention_blocks"):
        return replace(config, widths=widths["compact_unet"])
    return replace(config, widths=widths["unet"][: len(config.widths)])


def unpack(folder: Path, out: Path) -> None:
    """Write the run folders that a run packed to `out`, with its figures, and print how they are exported."""
    from lab.training.timed.packed_runs import read_parts

    for run in read_parts(folder, out):
        print(f"mirrorwave export {run} --out {out / run.name}.onnx")
    shutil.copyfile(folder / RESULTS, out / RESULTS)


if __name__ == "__main__":
    main()
