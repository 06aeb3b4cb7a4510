"""An installation: what the wheel holds, what it does in any folder, what it leaves of others, what it declares."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import sysconfig
import tomllib
import urllib.request
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from mirrorwave.floors import FLOORS
from msgs.files.shipped import CHECKOUT, WEIGHTS
from tests.installing import WITHIN, build_wheels, install, lend_kernels, make_environment, uninstall
from tests.test_house import imported_modules

#: Needed by others at run time, imported by none of ours: uvicorn takes it for web sockets.
INDIRECT = {"websockets"}
#: Import name -> distribution, where they differ.
DISTRIBUTIONS = {"PIL": "pillow", "can": "python-can", "yaml": "pyyaml", "zmq": "pyzmq"}
#: What only extras bring, and what only type checkers read.
OPTIONAL = {
    "cyclonedds", "onnx", "open3d", "osmium", "pytest", "ray", "rosbags", "h5py", "shapely", "submitit", "torch",
    "typing_extensions",
}  # fmt: skip


#: A module whose kernels the installation compiles and keeps itself; the others' are lent.
COMPILED = "models/perception/form/slow_time_sums.py"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of the checkout."""
    folder = tmp_path_factory.mktemp("wheel")
    build_wheels([CHECKOUT], folder)
    (made,) = folder.glob("*.whl")
    return made


@pytest.fixture(scope="module")
def environment(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A virtual environment with other people's `models` and `nodes`, and the wheel installed; then uninstalled."""
    folder = tmp_path_factory.mktemp("environment")
    packages = make_environment(folder)
    for name in ("models", "nodes"):
        (packages / name).mkdir()
        (packages / name / "__init__.py").write_text(f"OWNER = 'somebody else, {name}'\n")
    before = files_of(packages)
    install(folder, [wheel])
    assert before.items() <= files_of(packages).items()
    lend_kernels(packages, but=[COMPILED])
    yield folder
    uninstall(folder, "mirrorwave")
    assert files_of(packages) == before


def files_of(folder: Path) -> dict[str, bytes]:
    """Contents by name; compiled modules and kernels aside."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and path.suffix not in (".pyc", ".nbi", ".nbc")
    }


def run(environment: Path, folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run a program of the environment in a folder, with the distributions that the tests have."""
    variables = {**os.environ, "PYTHONPATH": sysconfig.get_path("purelib")}
    program = [str(environment / "bin" / words[0]), *words[1:]]
    return subprocess.run(program, cwd=folder, env=variables, capture_output=True, text=True, timeout=300, check=False)


def test_the_wheel_has_one_package_and_all_that_it_needs(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0] for name in names} == {"mirrorwave", "mirrorwave-0.2.0.dist-info"}
    within = "mirrorwave/floors_below/"
    needed = [path for name in (*FLOORS, "launch") for path in (CHECKOUT / name).rglob("*.*") if path.is_file()]
    needed = [path for path in needed if "__pycache__" not in path.parts]
    assert {f"{within}{path.relative_to(CHECKOUT)}" for path in needed} <= set(names)
    assert f"{within}docs/results/tradeoff.json" in names
    assert not [name for name in names if "__pycache__" in name]


def test_it_runs_in_a_folder_of_somebody_elses_models(environment: Path, tmp_path: Path) -> None:
    """Beside a `models` and a `nodes` in the working folder and in the environment, ours are used and shipped files are
    there by their names.
    """
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / "__init__.py").write_text("raise SystemExit('not this one')")
    for command in (["mirrorwave"], ["python", "-m", "mirrorwave"]):
        drawn = run(environment, tmp_path, *command, "graph", "launch/corner.yaml")
        assert drawn.returncode == 0, drawn.stderr
        assert "dense_predictor" in drawn.stdout
    findings = run(environment, tmp_path, "mirrorwave", "doctor", "--json")
    weights = [item for item in json.loads(findings.stdout) if item["check"].startswith("weights")]
    assert len(weights) == len(list(WEIGHTS.glob("*.onnx")))
    assert {item["status"] for item in weights} == {"ok"}


@pytest.mark.slow
def test_the_sample_is_processed_and_shown_anywhere(environment: Path, tmp_path: Path) -> None:
    """One command, no data: results and the page, which Ctrl-C ends; kernels are kept with the installation."""
    command = [str(environment / "bin" / "mirrorwave"), "process", "--sample", "--view", "--no-browser", "--port", "0"]
    variables = {**os.environ, "PYTHONPATH": sysconfig.get_path("purelib"), "PYTHONUNBUFFERED": "1"}
    with subprocess.Popen(command, cwd=tmp_path, env=variables, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            line = next((line for line in process.stdout if "open http" in line), "")
            assert line, "the page was not served"
            url = line.split("open ")[1].split()[0]
            for name in ("", "plots.js", "uplot.js", "uplot.css"):
                with urllib.request.urlopen(url + name, timeout=60) as answer:
                    assert answer.status == 200
        finally:
            process.send_signal(signal.SIGINT)
    assert process.returncode == 0
    results = {path.name for path in (tmp_path / "out" / "side_street").iterdir()}
    assert results == {"objects.jsonl", "tracks.jsonl", "timing.jsonl", "bev.png", "view.mcap"}
    (module,) = environment.glob(f"lib/python*/site-packages/{WITHIN / COMPILED}")
    assert [*module.parent.glob(f"__pycache__/{module.stem}.*.nbc")]


def test_it_uses_its_own_floors_and_leaves_those_of_others(environment: Path, tmp_path: Path) -> None:
    ours = run(environment, tmp_path, "python", "-c", "import mirrorwave, models; print(models.__file__)")
    assert "floors_below" in ours.stdout
    theirs = run(environment, tmp_path, "python", "-c", "import models; print(models.OWNER)")
    assert theirs.stdout.strip() == "somebody else, models"


def test_a_package_that_is_loaded_already_gets_an_honest_line(environment: Path, tmp_path: Path) -> None:
    late = run(environment, tmp_path, "python", "-c", "import nodes, mirrorwave")
    line = late.stderr.strip().splitlines()[-1]
    assert re.fullmatch(
        r"ImportError: mirrorwave has a package 'nodes' of its own, and another one is loaded already, "
        r"from \S+/nodes/__init__\.py: import mirrorwave first, or rename the other",
        line,
    )


def test_the_pythons_that_pip_accepts_are_those_that_are_named() -> None:
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())["project"]
    named = [re.fullmatch(r"Programming Language :: Python :: 3\.(\d+)", line) for line in project["classifiers"]]
    minors = sorted(int(match[1]) for match in named if match)
    assert minors == list(range(minors[0], minors[-1] + 1))
    assert project["requires-python"] == f">=3.{minors[0]},<3.{minors[-1] + 1}"


def imported() -> set[str]:
    """Top-level names that the floors import."""
    sources = [path.read_text() for name in (*FLOORS, "mirrorwave") for path in (CHECKOUT / name).rglob("*.py")]
    every = {name.split(".")[0] for source in sources for name in imported_modules(source)}
    return every - set(sys.stdlib_module_names) - {*FLOORS, "mirrorwave"}


def test_what_is_imported_is_declared() -> None:
    declared = {
        re.split(r"[<>=!~ ;\[]", line)[0].lower()
        for line in tomllib.loads((CHECKOUT / "pyproject.toml").read_text())["project"]["dependencies"]
    }
    needed = {DISTRIBUTIONS.get(name, name).lower() for name in imported() - OPTIONAL}
    assert declared == needed | INDIRECT
