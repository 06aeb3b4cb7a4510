"""`mirrorwave eval`: what a method's text means, one small run with all its files, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from lab.evaluate.method_runs import run_methods
from lab.evaluate.methods import build_method, overridden, parse_method
from lab.measures.frame_scores import measures
from lab.training.data.frames import DataSet, fixed_splits
from mirrorwave.cli import main
from models.perception.find.cfar import CfarParams
from models.perception.find.onnx_model import DEFAULT_MODEL, load_card
from models.perception.mirrors.peaks_to_view import GeometryParams
from sim_player.dataset.shards import Recipe
from sim_player.dataset.writer import write_dataset


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight places with the basic effects, split."""
    folder = write_dataset(tmp_path_factory.mktemp("data"), 8, 3, Recipe(effects="basic")).parent
    fixed_splits(folder)
    return folder


def test_text_of_a_method() -> None:
    spec = parse_method("ours=net.onnx,refine,residual=r.onnx,geometry=published,threshold=0.4,peaks.min_distance=3")
    assert (spec.name, spec.source, spec.refine, spec.geometry, spec.threshold) == (
        "ours",
        "net.onnx",
        True,
        "specification",
        0.4,
    )
    assert spec.residual == Path("r.onnx")
    assert spec.parameters == {"peaks": {"min_distance": 3}}
    assert (parse_method("cfar").name, parse_method("a/net.onnx").name) == ("cfar", "net")


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("ours=nothing", "source must be cfar, cfar-nlos, truth or FILE.onnx, got 'nothing'"),
        ("cfar,refine", "refine must go with a network"),
        ("cfar,sharpen", "got 'sharpen'"),
        ("n=a.onnx,refine=more", "got 'refine=more'"),
        ("cfar,geometry=best", "got 'geometry=best'"),
        ("cfar,threshold=2", "got 'threshold=2'"),
        ("cfar,peaks.min_distance=1", "group must be one of cfar, geometry, got 'peaks'"),
        ("cfar,cfar.false=4", "cfar.false must be one of false_alarm_rate, ridges"),
        ("cfar,cfar.false_alarm_rate=wide", "Expected `float`"),
        ("n=missing.onnx", "missing.json"),
        ("=cfar", "source must be"),
    ],
)
def test_unknown_words_are_refused_by_name(text: str, fault: str) -> None:
    with pytest.raises(ValueError, match="--method") as caught:
        build_method(parse_method(text))
    assert fault in str(caught.value)
    assert "\n" not in str(caught.value)


def test_parameters_are_replaced_by_dotted_key() -> None:
    got = overridden(GeometryParams(), "geometry", {"geometry": {"recovery.association": "buddy", "cluster_eps_m": 3}})
    assert (got.recovery.association, got.cluster_eps_m) == ("buddy", 3.0)
    assert overridden(CfarParams(), "cfar", {}) == CfarParams()


def test_threshold_of_a_network_is_that_of_the_method_then_that_of_its_card() -> None:
    text = f"n={DEFAULT_MODEL}"
    assert build_method(parse_method(f"{text},threshold=0.7")).threshold == 0.7
    assert build_method(parse_method(text)).threshold == load_card(DEFAULT_MODEL).threshold


def test_labels_as_peaks_are_perfect(folder: Path) -> None:
    """The dense scores of the truth itself are 1 with Chamfer 0: the scale every other row is read on.

    To 5e-6 m: labels have single precision, 4e-6 m at 60 m.
    """
    run = run_methods([build_method(parse_method("truth"))], DataSet(folder).frames(range(2)))
    found = measures(run.scores(run.runs[0]))
    assert found["dense_macro_f1"][0] == 1.0
    assert found["dense_macro_chamfer_m"][0] == pytest.approx(0.0, abs=5e-6)


def test_a_threshold_holds_without_a_network(folder: Path) -> None:
    (frame,) = DataSet(folder).frames(range(1))
    every, sure = (build_method(parse_method(text)).detect(frame) for text in ("cfar", "cfar,threshold=0.99"))
    assert len(sure) == np.count_nonzero(every.score >= 0.99)


@pytest.mark.slow
def test_one_run_with_all_its_files(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two methods over three frames; tables can be made again from the rows of the frames."""
    out = tmp_path / "out"
    words = ["eval", "--data", str(folder), "--split", "all", "--out", str(out)]
    words += ["--limit", "3"]
    words += ["--method", "cfar-nlos", "--method", f"net={DEFAULT_MODEL},geometry=ours"]
    assert main(words) == 0
    printed = capsys.readouterr().out
    test_sha256 = fixed_splits(folder).test_sha256
    assert test_sha256 in printed
    report = json.loads((out / "results.json").read_text())
    assert report["test_sha256"] == test_sha256
    assert [one["name"] for one in report["methods"]] == ["cfar-nlos", "net"]
    net = report["methods"][1]
    assert net["parameters"] == load_card(DEFAULT_MODEL).parameters
    assert net["milliseconds"]["detect"]["p90"] >= net["milliseconds"]["detect"]["median"] > 0.0
    counts = np.array(report["per_frame"]["methods"]["net"]["thinned"]["counts"])[:, :2].sum(axis=0)
    f1 = np.mean(2 * counts[:, 0] / (2 * counts[:, 0] + counts[:, 1] + counts[:, 2]))
    assert net["measures"]["thinned"]["dense_macro_f1"][0] == pytest.approx(f1)
    value, low, high = report["differences"]["cfar-nlos"]["dense_macro_f1"]
    assert low <= value <= high
    assert value == pytest.approx(report["methods"][0]["measures"]["thinned"]["dense_macro_f1"][0] - f1)
    assert "## Minus net, paired draws" in (out / "results.md").read_text()
    assert (out / "qualitative.png").read_bytes().startswith(b"\x89PNG")


def test_words_of_the_command_are_checked(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words, fault in (
        (["--method", "cfar,shine"], "got 'shine'"),
        (["--method", "cfar", "--method", "cfar"], "names must differ, got 'cfar' twice"),
        (["--split", "tset"], "tset"),
    ):
        assert main(["eval", "--data", str(folder), *words]) == 2
        error = capsys.readouterr().err
        assert fault in error
        assert error.count("\n") == 1
