"""`mirrorwave export`: a trained network as the file and card that the vehicle loads."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mirrorwave.console import AsJson, print_json, print_line, print_table


def export(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder of `mirrorwave train dense`.")],
    data: Annotated[Path, typer.Option(metavar="DIR", help="Data set the run was trained on.")],
    test: Annotated[Path, typer.Option(metavar="DIR", help="Data set of another seed, for the card's scores.")],
    out: Annotated[Path, typer.Option(metavar="FILE", help="ONNX file; its card is written beside it.")],
    as_json: AsJson = False,
) -> None:
    """Write the best network of a run as ONNX, with a card that says how it was made and how good it is."""
    from models.training.export_onnx import export_run

    card = export_run(run, test, out, data)
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
    print_line(f"{out}: {card.parameters} parameters, sha256 {card.sha256}")
