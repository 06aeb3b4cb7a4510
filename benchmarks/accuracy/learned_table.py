"""Every system of the specification and ours on the same frames: data, trainings, residuals, export, one table.

Trains each row for the same number of samples on the training split, chooses checkpoint and threshold on the
validation split, and evaluates all of them in one run on the test split. Whatever is there already is kept, so a run
that was stopped goes on.
Full sizes are trained by `benchmarks.accuracy.full_size`.
Usage: python -m benchmarks.accuracy.learned_table [--epochs 16] [--rows NAME ...] [--steps STEP ...]
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from lab.training.data.frames import fixed_splits

STEPS = ("train", "residual", "confidence", "eval")
MIRRORWAVE = (sys.executable, "-m", "mirrorwave.cli")
DATA = Path("data/places_v1")
#: 2160 scenes, split 1512/324/324 by scene; the test scenes' hash was frozen before the first training in this world.
DATA_COMMAND = ("sim", "dataset", "--count", "2160", "--seed", "7", "--workers", "2")
TEST_SHA256 = "87acb9dea701031f95d34deb47a84fb020a9299110d6bc2b54fecbfd88b8292d"
#: Rougher walls, clutter, gain and phase errors unknown to the receiver, dead beams; only tested on.
SHIFTED = Path("data/places_shifted")
SHIFTED_COMMAND = ("sim", "dataset", "--count", "324", "--seed", "9", "--shift", "hard", "--workers", "2")
#: Training scenes of our own simulator beyond the published 1512, for the row that says so.
MORE = Path("data/places_more")
MORE_COMMAND = ("sim", "dataset", "--count", "12000", "--seed", "8", "--workers", "2")


@dataclass(frozen=True)
class Row:
    """A training: name in the table, network by family, further arguments of `train dense`."""

    name: str
    network: str
    arguments: tuple[str, ...] = ()
    #: Also trained on `MORE`.
    more: bool = False
    #: Epochs relative to the others, which see fewer scenes an epoch.
    epochs_share: float = 1.0
    size: str = "compact"


ROWS = (
    Row("further_than_cfar", "further_than_cfar", ("--input", "log")),
    Row("rtn", "radar_tensor_network", ("--input", "log")),
    Row("unet", "unet", ("--input", "log")),
    Row("swin_unet", "swin_unet", ("--input", "log", "--learning-rate", "1e-3")),
    Row("ours", "compact_unet", ("--input", "levels+phase")),
    Row("ours_more", "compact_unet", ("--input", "levels+phase"), more=True, epochs_share=0.5),
    Row("ours_wide", "compact_unet", ("--input", "levels+phase"), more=True, epochs_share=0.375, size="wide"),
    Row("ours_levels", "compact_unet", ("--input", "levels")),
    Row("ours_log", "compact_unet", ("--input", "log")),
    Row("ours_complex", "compact_unet", ("--input", "complex")),
    Row("ours_both", "compact_unet", ("--input", "both")),
    Row("ours_binary", "compact_unet", ("--input", "levels+phase", "--objective", "binary")),
    Row("ours_without", "compact_unet",
        ("--input", "levels+phase", "--without", "relay=container", "--without", "object=bus")),
)  # fmt: skip


def main(argv: Sequence[str] | None = None) -> None:
    options = _options(argv)
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    _data_set(DATA, DATA_COMMAND)
    if (found := fixed_splits(DATA).test_sha256) != TEST_SHA256:
        sys.exit(f"{DATA}: test scenes must be the frozen ones, {TEST_SHA256}, got {found}")
    by_name = {row.name: row for row in ROWS}
    rows = [by_name[name] for name in options.rows or by_name]
    if any(row.more for row in rows):
        _data_set(MORE, MORE_COMMAND)
    if "train" in options.steps:
        with ThreadPoolExecutor(options.lanes) as lanes:
            list(lanes.map(lambda row: _train(row, options), rows))
        _budgets(options)
    if "residual" in options.steps:
        _residuals(options)
    if "confidence" in options.steps:
        _confidences(options)
    if "eval" in options.steps:
        _evaluate(options)


def _options(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--epochs", type=int, default=16, help="over the 1512 training scenes, each row")
    parser.add_argument("--rows", nargs="*", default=[], choices=[row.name for row in ROWS], help="in this order")
    parser.add_argument("--steps", nargs="*", default=STEPS, choices=STEPS)
    parser.add_argument("--sweep", type=int, default=8, help="thresholds of the precision-recall curves")
    parser.add_argument("--lanes", type=int, default=2, help="trainings at a time, one thread each")
    parser.add_argument("--work", type=Path, default=Path("runs/table"))
    parser.add_argument("--out", type=Path, default=Path("runs/table/results"))
    return parser.parse_args(argv)


def _data_set(folder: Path, command: tuple[str, ...]) -> None:
    if not (folder / "manifest.jsonl").exists():
        _mirrorwave(*command, "--out", str(folder))


def _train(row: Row, options: argparse.Namespace) -> None:
    """Train a row to its last epoch and export it."""
    run = options.work / row.name
    arguments = ["--network", f"{row.network}:{row.size}", "--seed", "0", *row.arguments]
    if row.more:
        arguments += ["--more", str(MORE)]
    arguments += ["--epochs", str(max(round(options.epochs * row.epochs_share), 1))]
    _mirrorwave(
        "train", "dense", "--data", str(DATA), "--out", str(run), *arguments, log=options.work / f"{row.name}.log"
    )
    if not _model(options, row.name).exists():
        _mirrorwave("export", str(run), "--split", "validation", "--out", str(_model(options, row.name)))


def _residuals(options: argparse.Namespace) -> None:
    """The residual of the published chain on what the Swin-UNet finds, and ours on what ours finds."""
    for name, model, geometry in (("residual_published", "swin_unet", "published"), ("residual_ours", "ours", "ours")):
        _mirrorwave(
            "train", "residual", "--data", str(DATA), "--out", str(options.work / name), "--geometry", geometry,
            "--model", str(_model(options, model)), log=options.work / f"{name}.log",
        )  # fmt: skip


def _confidences(options: argparse.Namespace) -> None:
    """How likely folded places are, for the networks and ways that are shown with all our stages."""
    asked = dict.fromkeys((source, FLIP in way) for _, source, way, beside in TABLE if beside == "confidence")
    for name, flip in asked:
        out = _confidence(options, name, flip)
        if _model(options, name).exists() and not out.exists():
            words = ["train", "confidence", "--data", str(DATA), "--model", str(_model(options, name))]
            _mirrorwave(*words, *(["--flip-test"] if flip else []), "--out", str(out))


def _confidence(options: argparse.Namespace, name: str, flip: bool) -> Path:
    return options.work / f"{name}{'.flip' if flip else ''}.confidence.json"


def _evaluate(options: argparse.Namespace) -> None:
    """One run over the test split with every method, one over the shifted scenes with the learned ones."""
    _data_set(SHIFTED, SHIFTED_COMMAND)
    common = ("--reference", "UNet", "--threads", "2", "--sweep", str(options.sweep))
    _mirrorwave("eval", "--data", str(DATA), "--truth", "both", *common, "--out", str(options.out), *_methods(options))
    shifted = ("eval", "--data", str(SHIFTED), "--split", "all", *common, "--out", str(options.out / "shifted"))
    _mirrorwave(*shifted, *_methods(options, privileged=False))


def _budgets(options: argparse.Namespace) -> None:
    """What each row was trained with and came to on the validation split, beside the table."""
    lines = [
        "| row | scenes | epochs | samples | parameters | best Macro-F1 | at | |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in ROWS:
        path = options.work / row.name / "summary.json"
        if not path.exists():
            continue
        one = json.loads(path.read_text())
        best = one["best"]
        lines.append(
            f"| {row.name} | {one['scenes']} | {one['epochs']} | {one['sample_steps']} | {one['parameters']} "
            f"| {best['best_macro_f1']:.3f} | {best['best_threshold']} "
            f"| {'still rising: not converged' if one['unconverged'] else ''} |"
        )
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "training.md").write_text("\n".join(lines) + "\n")


PUBLISHED, FLIP = "geometry=published", "flip_test"
LEARNED = {"Further-than-CFAR": "further_than_cfar", "RTN": "rtn", "UNet": "unet", "Swin-UNet": "swin_unet"}
INPUTS = {
    "levels": "ours_levels",
    "log magnitude": "ours_log",
    "complex": "ours_complex",
    "complex and log": "ours_both",
    "binary segmentation": "ours_binary",
}
#: The table: label, what answers (a row of `ROWS`, or a method without a network), peaks and back end, and what is
#: learned beside it: a residual, or the confidence of places.
TABLE: tuple[tuple[str, str, str, str], ...] = (
    ("CFAR-NLOS", "cfar-nlos", PUBLISHED, ""),
    *((label, row, PUBLISHED, "") for label, row in LEARNED.items()),
    ("Swin-UNet + residual", "swin_unet", PUBLISHED, "residual_published"),
    ("Ours (published peaks and back end)", "ours", PUBLISHED, ""),
    ("Ours (published back end)", "ours", f"refine=pursuit,{PUBLISHED}", ""),
    ("Ours (no confidence)", "ours", "refine=pursuit", ""),
    ("Ours", "ours", "refine=pursuit", "confidence"),
    ("Ours + residual", "ours", "refine=pursuit", "residual_ours"),
    ("Ours (more scenes)", "ours_more", "refine=pursuit", "confidence"),
    ("Ours (more scenes and flip test)", "ours_more", f"refine=pursuit,{FLIP}", "confidence"),
    ("Ours (wide on more scenes)", "ours_wide", "refine=pursuit", "confidence"),
    ("Ours (wide on more scenes and flip test)", "ours_wide", f"refine=pursuit,{FLIP}", "confidence"),
    *((f"Ours ({label})", row, "refine=pursuit", "") for label, row in INPUTS.items()),
    ("Ours (without container and bus)", "ours_without", "refine=pursuit", ""),
    *((f"{label} (our back end)", row, "", "") for label, row in LEARNED.items()),
    ("UNet (all our stages)", "unet", "refine=pursuit", "confidence"),
    ("UNet (all our stages and flip test)", "unet", f"refine=pursuit,{FLIP}", "confidence"),
    ("Truth (published back end)", "truth", PUBLISHED, ""),
    ("Truth (our back end)", "truth", "", ""),
)


def _methods(options: argparse.Namespace, privileged: bool = True) -> list[str]:
    """The table as words of `mirrorwave eval`, without rows that are not trained and, if so asked, without truth."""
    words = []
    for label, source, way, beside in TABLE:
        learned = source in {row.name for row in ROWS}
        beside_file = _beside(options, source, way, beside)
        if (learned and not _model(options, source).exists()) or (beside_file and not beside_file.exists()):
            continue
        if learned or privileged:
            parts = [f"{label}={_network(options, source, way) if learned else source}", way]
            parts += [f"{beside.partition('_')[0]}={beside_file}"] if beside_file else []
            words += ["--method", ",".join(filter(None, parts))]
    return words


def _beside(options: argparse.Namespace, source: str, way: str, beside: str) -> Path | None:
    """The file of what is learned beside a network."""
    if beside == "confidence":
        return _confidence(options, source, FLIP in way)
    return options.work / beside / "residual.onnx" if beside else None


def _network(options: argparse.Namespace, name: str, way: str) -> str:
    """A network; local maxima at their best threshold on the validation split, where its card was scored."""
    if "refine=pursuit" in way:
        return str(_model(options, name))
    scores = json.loads(_model(options, name).with_suffix(".json").read_text())["scores"]
    return f"{_model(options, name)},threshold={max(scores, key=lambda line: line['macro_f1'])['threshold']}"


def _model(options: argparse.Namespace, name: str) -> Path:
    return options.work / f"{name}.onnx"


def _mirrorwave(*arguments: str, log: Path | None = None) -> None:
    """Run a verb; its words go to a file where one is given."""
    if log is None:
        subprocess.run((*MIRRORWAVE, *arguments), check=True)
        return
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("ab") as file:
        subprocess.run((*MIRRORWAVE, *arguments), check=True, stdout=file)


if __name__ == "__main__":
    main()
