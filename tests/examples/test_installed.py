"""Packages of others beside an installation of mirrorwave, in an environment of their own and outside the checkout."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sysconfig
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from msgs.files.shipped import CHECKOUT
from msgs.recording.mcap import RecordingReader
from tests.installing import build_wheels, install, lend_kernels, make_environment

pytestmark = [pytest.mark.graph, pytest.mark.slow]
EXAMPLES = CHECKOUT / "examples"


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A virtual environment with the wheels of mirrorwave and of the example packages."""
    wheels, folder = tmp_path_factory.mktemp("wheels"), tmp_path_factory.mktemp("environment")
    build_wheels([CHECKOUT, *(EXAMPLES / name for name in ("my_radar", "my_effect", "my_topic"))], wheels)
    packages = make_environment(folder)
    install(folder, wheels.glob("*.whl"))
    lend_kernels(packages)
    return folder


@pytest.fixture
def run_dir() -> Iterator[str]:
    # a short path: socket names are limited
    with tempfile.TemporaryDirectory(prefix="mw") as folder:
        yield folder


def run(environment: Path, folder: Path, run_dir: str, *words: str) -> str:
    """Run `mirrorwave` of the environment in a folder, with the distributions that the tests have; its output."""
    variables = {**os.environ, "PYTHONPATH": sysconfig.get_path("purelib"), "MIRRORWAVE_RUN_DIR": run_dir}
    program = [str(environment / "bin" / "mirrorwave"), *words]
    done = subprocess.run(program, cwd=folder, env=variables, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_a_radar_of_a_package_drives_the_graph(environment: Path, tmp_path: Path, run_dir: str) -> None:
    """The node is listed with its package; the graph of its launch file has its beams, and views made of them."""
    rows = json.loads(run(environment, tmp_path, run_dir, "node", "types", "--json"))
    (row,) = [row for row in rows if row["package"] == "my-radar 0.1"]
    assert (row["module"], row["outputs"], row["error"]) == ("my_radar", ["radar/setup", "radar/beam"], "")
    launch = tmp_path / "launch.yaml"
    launch.write_text((EXAMPLES / "my_radar" / "launch.yaml").read_text())
    for duration_s in ("3", "12", "60"):
        recording = tmp_path / f"{duration_s}.mcap"
        run(environment, tmp_path, run_dir, "launch", str(launch), "--duration", duration_s, "--record", str(recording))
        with RecordingReader(recording) as reader:
            topics = {message.topic for message in reader.messages(["radar/setup", "perception/hidden_objects"])}
        if len(topics) == 2:
            return
    raise TimeoutError("no view in a minute")


def test_a_topic_of_a_package_is_known_and_its_test_has_the_fixtures(
    environment: Path, tmp_path: Path, run_dir: str
) -> None:
    """pytest finds the plug-in by its entry point; a test need not import mirrorwave first."""
    topics = json.loads(run(environment, tmp_path, run_dir, "topic", "list", "--json"))
    assert [topic["topic"] for topic in topics if topic["type"] == "Distances"] == ["my/distances"]
    shutil.copy(EXAMPLES / "my_topic" / "test_my_distances.py", tmp_path)
    command = [str(environment / "bin" / "python"), "-m", "pytest", "-q", "-W", "error", "-p", "no:dash", "--rootdir=."]
    variables = {**os.environ, "PYTHONPATH": sysconfig.get_path("purelib")}
    done = subprocess.run(command, cwd=tmp_path, env=variables, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_an_effect_of_a_package_is_planned(environment: Path, tmp_path: Path, run_dir: str) -> None:
    scene = EXAMPLES / "my_scene" / "rainy_yard.yaml"
    plan = json.loads(run(environment, tmp_path, run_dir, "sim", "effects", str(scene), "--json"))
    (row,) = [row for row in plan["effects"] if row["name"] == "wet_radome"]
    assert row["used"]
    # 1.46 dB on each of two passes: a third of the field
    assert row["bound_db"] > -20.0
    dry = tmp_path / "dry.yaml"
    text = (
        scene.read_text()
        .replace("rain_mm_per_h: 10.0", "rain_mm_per_h: 0.0")
        .replace("tank.obj", str(scene.parent / "tank.obj"))
    )
    dry.write_text(text)
    plan = json.loads(run(environment, tmp_path, run_dir, "sim", "effects", str(dry), "--json"))
    (row,) = [row for row in plan["effects"] if row["name"] == "wet_radome"]
    assert (row["used"], row["reason"]) == (False, "it does not rain")
    findings = json.loads(run(environment, tmp_path, run_dir, "doctor", "--json"))
    checks = {finding["check"]: finding["status"] for finding in findings}
    assert checks["node my_radar of my-radar 0.1"] == "ok"
    assert checks["effect wet_radome of my-effect 0.1"] == "ok"
