"""Modules by their former names."""

from __future__ import annotations

import importlib
import subprocess
import sys

import pytest

from msgs.files.former_modules import FORMER, know_former_names, present_name
from msgs.files.shipped import CHECKOUT


@pytest.mark.parametrize(
    ("former", "present"),
    [
        ("models.perception.geometry.stage", "models.perception.mirrors.peaks_to_view"),
        ("models.perception.geometry.walls", "models.perception.mirrors.walls"),
        ("models.perception.geometry_of_ours", "models.perception.geometry_of_ours"),
        ("nodes.link", "contrib.two_machines.link"),
        ("nodes.geometry", "nodes.geometry"),
        ("numpy", "numpy"),
    ],
)
def test_a_former_name_is_that_of_the_longest_room(former: str, present: str) -> None:
    assert present_name(former) == present


def test_every_present_name_is_a_module_and_no_former_one_is() -> None:
    know_former_names()
    for former, present in FORMER.items():
        assert importlib.util.find_spec(present) is not None, present
        assert not (CHECKOUT / former.replace(".", "/")).with_suffix(".py").exists(), former


def test_a_module_by_its_former_name_is_the_module_itself() -> None:
    """In a process that knows none of them yet; nothing is loaded twice, and a module keeps its own name."""
    script = """
import sim_player.trace.ray_tracing as former
import models.perception.detection.encoding as encoding
from sim_player.paths import ray_tracing
from models.perception.find import encoding as own
assert former is ray_tracing and former.__name__ == former.__spec__.name == "sim_player.paths.ray_tracing", former
assert encoding is own and own.Encoding.__module__ == "models.perception.find.encoding"
"""
    done = subprocess.run([sys.executable, "-W", "error", "-c", script], cwd=CHECKOUT, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
