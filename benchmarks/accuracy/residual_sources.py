"""What ResidualReflectNet should be trained on: labels or detections, in which frame, from which images.

Trains each combination on the training scenes and evaluates all of them in one run on the test scenes, under the
published back end and under ours. What is trained already is kept.
Usage: python -m benchmarks.accuracy.residual_sources [--data DIR] [--model FILE] [--epochs 40] [--work DIR]
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from itertools import product
from pathlib import Path

from models.perception.detection.onnx_model import DEFAULT_MODEL

MIRRORWAVE = (sys.executable, "-m", "mirrorwave.cli")
SOURCES, FRAMES = ("truth", "peaks", "both"), ("radar", "wall")
#: Learn from images folded within 2 m of their true place, or from all as published.
REACHES_M = (2.0, 1000.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("data/places_v1"))
    parser.add_argument("--model", type=Path, default=DEFAULT_MODEL)
    parser.add_argument("--epochs", type=int, default=40)
    parser.add_argument("--work", type=Path, default=Path("runs/residual_sources"))
    options = parser.parse_args()
    methods = []
    for geometry in ("ours", "published"):
        methods += ["--method", f"{geometry} / none={options.model},geometry={geometry}"]
        for source, frame, reach_m in product(SOURCES, FRAMES, REACHES_M):
            name = f"{geometry}-{source}-{frame}-{reach_m:.0f}"
            _train(options, name, geometry, source, frame, reach_m)
            residual = options.work / name / "residual.onnx"
            label = f"{geometry} / {source} / {frame} / {'all' if reach_m > 100.0 else f'{reach_m:.0f} m'}"
            methods += ["--method", f"{label}={options.model},geometry={geometry},residual={residual}"]
    out = ("--sweep", "0", "--reference", "ours / none", "--out", str(options.work / "results"))
    subprocess.run((*MIRRORWAVE, "eval", "--data", str(options.data), *out, *methods), check=True)


def _train(options: argparse.Namespace, name: str, geometry: str, source: str, frame: str, reach_m: float) -> None:
    """Train one combination to its last epoch."""
    words = ("--geometry", geometry, "--source", source, "--frame", frame, "--reach-m", str(reach_m))
    common = ("--data", str(options.data), "--model", str(options.model), "--epochs", str(options.epochs))
    run = ("train", "residual", *common, *words, "--out", str(options.work / name))
    subprocess.run((*MIRRORWAVE, *run), check=True)


if __name__ == "__main__":
    main()
