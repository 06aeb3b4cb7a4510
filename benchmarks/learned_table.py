"""Every system of the specification and ours on the same frames: data, trainings, residuals, export, one table.

Trains each row for the same number of samples on the training split, chooses checkpoint and threshold on the
validation split, and evaluates all of them in one run on the test split. Whatever is there already is kept, so a run
that was stopped goes on.
Usage: python -m benchmarks.learned_table [--budget cpu|gpu] [--epochs 24] [--rows NAME ...] [--lanes 2] [--out DIR]
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

MIRRORWAVE = (sys.executable, "-m", "mirrorwave.cli")
DATA = Path("data/places_v1")
#: 2160 scenes, split 1512/324/324 by scene; the test scenes' hash was frozen before the first training.
DATA_COMMAND = ("sim", "dataset", "--count", "2160", "--seed", "7", "--workers", "2")
TEST_SHA256 = "37516c4c278be06a6fdb85764bf79f885e249c6a18de80b614e37dfa029de74b"
#: Training scenes of our own simulator beyond the published 1512, for the row that says so.
MORE = Path("data/places_more")
MORE_COMMAND = ("sim", "dataset", "--count", "5100", "--seed", "8", "--workers", "2")


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


ROWS = (
    Row("further_than_cfar", "further_than_cfar", ("--input", "log")),
    Row("rtn", "radar_tensor_network", ("--input", "log")),
    Row("unet", "unet", ("--input", "log")),
    Row("swin_unet", "swin_unet", ("--input", "log", "--learning-rate", "1e-3")),
    Row("ours", "compact_unet", ("--input", "levels+phase")),
    Row("ours_more", "compact_unet", ("--input", "levels+phase"), more=True, epochs_share=0.5),
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
    rows = [row for row in ROWS if not options.rows or row.name in options.rows]
    if any(row.more for row in rows):
        _data_set(MORE, MORE_COMMAND)
    with ThreadPoolExecutor(options.lanes) as lanes:
        list(lanes.map(lambda row: _train(row, options), rows))
    if not options.rows:
        _residuals(options)
        _evaluate(options)


def _options(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--budget", choices=("cpu", "gpu"), default="cpu")
    parser.add_argument("--epochs", type=int, default=24, help="over the 1512 training scenes, each row; gpu: 100")
    parser.add_argument("--rows", nargs="*", default=[], choices=[row.name for row in ROWS], help="train only these")
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
    size = "compact" if options.budget == "cpu" else "full" if row.network != "compact_unet" else "wide"
    arguments = ["--network", f"{row.network}:{size}", "--seed", "0", *row.arguments]
    if row.more:
        arguments += ["--more", str(MORE)]
    epochs = 100 if options.budget == "gpu" else options.epochs
    if options.budget == "gpu":
        arguments += ["--schedule", "published"] if row.network != "compact_unet" else []
    arguments += ["--epochs", str(max(round(epochs * row.epochs_share), 1))]
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


def _evaluate(options: argparse.Namespace) -> None:
    """One run over the test split with every method."""
    words = [word for text in _methods(options) for word in ("--method", text)]
    _mirrorwave(
        "eval", "--data", str(DATA), "--split", "test", "--truth", "both", "--reference", "UNet", "--threads", "2",
        "--out", str(options.out), *words,
    )  # fmt: skip


def _methods(options: argparse.Namespace) -> list[str]:
    """The rows of the table as `mirrorwave eval` takes them; thresholds were chosen on the validation split."""

    def network(label: str, name: str, *words: str) -> str:
        scores = json.loads(_model(options, name).with_suffix(".json").read_text())["scores"]
        threshold = max(scores, key=lambda line: line["macro_f1"])["threshold"]
        return ",".join((f"{label}={_model(options, name)}", f"threshold={threshold}", *words))

    def learned(name: str) -> str:
        return f"residual={options.work / name / 'residual.onnx'}"

    published = "geometry=published"
    named = (("Further-than-CFAR", "further_than_cfar"), ("RTN", "rtn"), ("UNet", "unet"), ("Swin-UNet", "swin_unet"))
    return [
        f"CFAR-NLOS=cfar-nlos,{published}",
        *(network(label, name, published) for label, name in named),
        network("Swin-UNet + residual", "swin_unet", published, learned("residual_published")),
        network("Ours, published back end", "ours", published),
        network("Ours", "ours"),
        network("Ours + residual", "ours", learned("residual_ours")),
        network("Ours, more scenes", "ours_more"),
        *(network(f"{label}, our back end", name) for label, name in named),
        f"Truth, published back end=truth,{published}",
        "Truth, our back end=truth",
    ]


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
