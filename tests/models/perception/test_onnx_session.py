"""int8 networks answer the same on every processor."""

from __future__ import annotations

import os
import platform
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
from scipy.special import expit

from models.perception.onnx_session import session_of
from msgs.files.shipped import WEIGHTS

NETWORKS = ("compact_unet.int8", "compact_unet.near.int8", "evidence_unet.int8", "field_unet.int8")
ROOT = Path(__file__).parents[3]
#: Writes the answers of the networks to the inputs of a file.
CHILD = """
import sys
from pathlib import Path
import numpy as np
from models.perception.onnx_session import session_of
from msgs.files.shipped import WEIGHTS

def answer(name, cells):
    path = WEIGHTS / f"{name}.onnx"
    session = session_of(path, path.read_bytes(), 1)
    return session.run(None, {session.get_inputs()[0].name: cells})[0]

cells = np.load(sys.argv[1])
np.savez(sys.argv[2], **{name: answer(name, cells[name]) for name in cells.files})
"""


def inputs(names: Iterable[str]) -> dict[str, np.ndarray]:
    """Return an input of each network, as loud as a map full of echoes: sums that could be cut off."""
    rng = np.random.default_rng(0)
    sessions = {name: onnxruntime.InferenceSession(WEIGHTS / f"{name}.onnx") for name in names}
    return {name: rng.random(session.get_inputs()[0].shape, np.float32) for name, session in sessions.items()}


#: Largest differences on ARM: QLinearAdd rounds otherwise in 3 of 100,000 sums, and what follows carries it on. The
#: field network answers in steps of 0.148.
ON_ARM = {"evidence_unet.int8": 0.03, "field_unet.int8": 0.3}


# max: AVX2 without VNNI; Nehalem: SSE alone
@pytest.mark.parametrize(("processor", "names"), [("max", NETWORKS), ("Nehalem", ("compact_unet.near.int8",))])
def test_committed_networks_answer_the_same_on_an_emulated_processor(
    processor: str, names: tuple[str, ...], tmp_path: Path
) -> None:
    emulator = shutil.which("qemu-x86_64")
    if emulator is None or platform.machine() != "x86_64":
        pytest.skip("needs qemu-x86_64 (package qemu-user) on x86-64")
    compare([emulator, "-cpu", processor, sys.executable], names, {}, tmp_path)


def test_committed_networks_answer_alike_on_arm(tmp_path: Path) -> None:
    """`MIRRORWAVE_AARCH64_PYTHON` runs an aarch64 Python with the packages, for example under qemu-aarch64."""
    python = os.environ.get("MIRRORWAVE_AARCH64_PYTHON")
    if python is None:
        pytest.skip("needs MIRRORWAVE_AARCH64_PYTHON, an aarch64 Python with onnxruntime")
    compare(shlex.split(python), NETWORKS, ON_ARM, tmp_path)


def compare(python: list[str], names: tuple[str, ...], tolerances: dict[str, float], folder: Path) -> None:
    """Assert that another Python has the same answers, to 0.01 where no other tolerance is given."""
    cells = inputs(names)
    np.savez(folder / "cells.npz", **cells)
    subprocess.run(
        [*python, "-c", CHILD, folder / "cells.npz", folder / "there.npz"], cwd=ROOT, check=True, timeout=600
    )
    with np.load(folder / "there.npz") as there:
        for name, values in cells.items():
            path = WEIGHTS / f"{name}.onnx"
            session = session_of(path, path.read_bytes(), 1)
            (here,) = session.run(None, {session.get_inputs()[0].name: values})
            as_shares = expit if name.startswith("evidence") else np.asarray
            tolerance = tolerances.get(name, 0.01)
            np.testing.assert_allclose(as_shares(there[name]), as_shares(here), atol=tolerance, err_msg=name)
