"""`mirrorwave export`: a trained network as the file and card that the vehicle loads."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from mirrorwave.console import AsJson, print_json, print_line, print_table, progress_bar


def export(
    run: Annotated[
        Path,
        typer.Argument(
            metavar="RUN|FILE",
            help="Run folder of `mirrorwave train dense`; or an exported evidence network, for --precision int8.",
        ),
    ],
    out: Annotated[Path, typer.Option(metavar="FILE", help="ONNX file; its card is written beside it.")],
    data: Annotated[Path | None, typer.Option(metavar="DIR", help="Data set of the run, if it moved.")] = None,
    precision: Annotated[
        Literal["fp32", "fp16", "int8"], typer.Option(help="Numbers inside the network; input and output stay fp32.")
    ] = "fp32",
    as_json: AsJson = False,
) -> None:
    """Write the best network of a run as ONNX, with a card that says how it was made and how good it is."""
    from lab.training.export.onnx import ExportConfig, export_run

    if run.suffix == ".onnx":
        _export_evidence(run, out, data, precision, as_json)
        return
    config = ExportConfig(data_dir=data, precision=precision)
    with progress_bar("export") as progress:
        card = export_run(run, out, config, report=progress.print)
    if as_json:
        print_json(card)
        return
    print_table(
        ("threshold", "macro_f1", "los_precision", "los_recall", "mirrored_precision", "mirrored_recall"),
        [
            (s.threshold, s.macro_f1, s.los.precision, s.los.recall, s.mirrored.precision, s.mirrored.recall)
            for s in card.scores
        ],
    )
    print_line(f"{out}: {card.network}, {card.parameters} parameters, {card.precision}, sha256 {card.sha256}")
    if card.fidelity is not None:
        print_line(
            f"largest difference from torch {card.fidelity.largest_difference:.2g}, "
            f"{card.fidelity.lost_points:+.2f} points of Macro-F1 lost to precision"
        )


def _export_evidence(source: Path, out: Path, data: Path | None, precision: str, as_json: bool) -> None:
    """Write an exported evidence network in 8-bit integers."""
    from lab.training.data.frames import DataSet
    from lab.training.export.evidence import quantize_evidence
    from lab.training.export.onnx import ExportConfig

    if precision != "int8" or data is None:
        raise ValueError(f"{source}: an exported network takes --precision int8 and --data, a data set of its training")
    with progress_bar("export"):
        card = quantize_evidence(source, DataSet(data), ExportConfig().calibration_maps, out)
    if as_json:
        print_json(card)
        return
    print_line(f"{out}: {card.parameters} parameters, int8, sha256 {card.sha256}")
    print_line(f"largest difference of a probability {card.scores['largest_probability_difference']:.2g}")
