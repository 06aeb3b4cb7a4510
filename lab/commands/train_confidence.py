"""`mirrorwave train confidence`: how likely a folded place is true."""

from __future__ import annotations

from functools import partial
from itertools import chain
from pathlib import Path
from typing import Annotated

import typer

from mirrorwave.console import AsJson, print_json, print_line, progress_bar

#: Where the detector's peaks are placed.
REFINE = "pursuit"


def confidence(
    data: Annotated[Path, typer.Option(metavar="DIR", help="Data set; its fixed splits train and choose.")],
    out: Annotated[Path, typer.Option(metavar="FILE.json", help="The fitted model.")],
    model: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Detector (ONNX); default: the committed one.")
    ] = None,
    flip_test: Annotated[
        bool, typer.Option("--flip-test", help="Mean answer of the detector to a map and to its mirror image.")
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
    from msgs.files.whole_files import write_whole

    path = model or DEFAULT_MODEL
    card = load_card(path)
    scenes, splits = DataSet(data), fixed_splits(data)
    peaks = PeakParams(threshold=card.threshold_for(REFINE))
    detector = NetworkDetector(scenes.setup, path, 1, peaks, refine=REFINE, flip_test=flip_test)
    places = {}
    for split in ("train", "validation"):
        # a perfect radar sees each scene, and an imperfect one
        by_imperfect = scenes.frames(splits.of(split), partial(imperfect, seed=seed, setup=scenes.setup))
        frames = chain(scenes.frames(splits.of(split)), by_imperfect)
        with progress_bar(f"{split} scenes", 2 * len(splits.of(split))) as on_scene:
            places[split] = collected(frames, detector, GeometryParams(), on_scene)
    command = f"mirrorwave train confidence --data {data} --out {out} --model {path}"
    command += f"{' --flip-test' if flip_test else ''} --seed {seed}"
    fitted = msgspec.structs.replace(
        fit_confidence(places["train"], places["validation"], FitConfig(seed=seed)),
        detector=detector_name(card.sha256, REFINE, flip_test),
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
