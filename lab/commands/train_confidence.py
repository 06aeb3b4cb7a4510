"""`mirrorwave train confidence`: how likely a folded place is true."""

from __future__ import annotations

from functools import partial
from itertools import chain
from pathlib import Path
from typing import Annotated, Literal

import typer

from mirrorwave.console import AsJson, print_json, print_line, progress_bar


def confidence(
    data: Annotated[Path, typer.Option(metavar="DIR", help="Data set; its fixed splits train and choose.")],
    out: Annotated[Path, typer.Option(metavar="FILE.json", help="The fitted model.")],
    model: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Detector (ONNX); default: the committed one.")
    ] = None,
    refine: Annotated[
        Literal["none", "pursuit"],
        typer.Option(help="Where its peaks are placed."),
    ] = "pursuit",
    threshold: Annotated[
        float | None, typer.Option(min=0.0, max=1.0, help="Score a peak must have; default: the card's.")
    ] = None,
    residual: Annotated[Path | None, typer.Option(metavar="FILE", help="Learned correction of the places.")] = None,
    flip_test: Annotated[
        bool, typer.Option("--flip-test", help="Mean answer of the detector to a map and to its mirror image.")
    ] = False,
    clean: Annotated[
        bool, typer.Option("--clean", help="A perfect radar only; else each scene is seen by an imperfect one too.")
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="First weights, imperfections.")] = 0,
    json: AsJson = False,
) -> None:
    """Fit the probability that a folded place is true, to what a detector finds and the geometry stage makes of it."""
    import msgspec

    from lab.training.data.frames import DataSet, fixed_splits
    from lab.training.data.samples import imperfect
    from lab.training.fit_confidence import FitConfig, collected, fit_confidence
    from models.perception.find.detectors import NetworkDetector, detector_name
    from models.perception.find.onnx_model import DEFAULT_MODEL, load_card
    from models.perception.find.peaks import PeakParams
    from models.perception.mirrors.peaks_to_view import GeometryParams
    from models.perception.mirrors.residual_model import LearnedResidual
    from msgs.files.whole_files import write_whole

    path = model or DEFAULT_MODEL
    card = load_card(path)
    at = card.threshold_for(refine) if threshold is None else threshold
    correction = None if residual is None else LearnedResidual(residual)
    if correction is not None:
        correction.require_trained_for(GeometryParams().back_end)
    scenes, splits = DataSet(data), fixed_splits(data)
    detector = NetworkDetector(scenes.setup, path, 1, PeakParams(threshold=at), refine=refine, flip_test=flip_test)
    places = {}
    for split in ("train", "validation"):
        frames = scenes.frames(splits.of(split))
        if not clean:
            frames = chain(frames, scenes.frames(splits.of(split), partial(imperfect, seed=seed, setup=scenes.setup)))
        with progress_bar(f"{split} scenes", len(splits.of(split)) * (1 if clean else 2)) as on_scene:
            places[split] = collected(frames, detector, GeometryParams(), correction, on_scene)
    command = f"mirrorwave train confidence --data {data} --out {out} --model {path} --refine {refine}"
    command += f" --threshold {at:g}{f' --residual {residual}' if residual else ''}"
    command += f"{' --flip-test' if flip_test else ''}{' --clean' if clean else ''} --seed {seed}"
    fitted = msgspec.structs.replace(
        fit_confidence(places["train"], places["validation"], FitConfig(seed=seed)),
        detector=detector_name(card.sha256, refine, flip_test),
        command=command,
        data={"directory": str(data), "test_sha256": splits.test_sha256},
    )
    write_whole(out, msgspec.json.format(msgspec.json.encode(fitted), indent=1) + b"\n")
    scores = fitted.metrics
    if json:
        print_json({"threshold": fitted.threshold, **scores})
        return
    print_line(
        f"{out}: on validation scenes recovered F1 {scores['f1_1m']:.3f} at {fitted.threshold:g} "
        f"(without {scores['f1_1m_without']:.3f}), calibration error {scores['calibration_error']:.3f} "
        f"(peak scores {scores['calibration_error_without']:.3f})"
    )
