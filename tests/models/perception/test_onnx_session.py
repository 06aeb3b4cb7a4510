"""int8 networks answer the same on every processor."""

from __future__ import annotations

import logging
import platform
import shutil
import subprocess
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import onnxruntime
import pytest
from scipy.special import expit

from models.perception import onnx_session
from models.perception.onnx_session import IntegerKernels, integer_kernels, session_of
from msgs.files.shipped import WEIGHTS

NETWORKS = ("compact_unet.int8", "compact_unet.near.int8", "object_unet.int8")
ROOT = Path(__file__).parents[3]
#: Writes the answers of the networks to the inputs of a file, and prints the kernels.
CHILD = """
import sys
from pathlib import Path
import numpy as np
from models.perception.onnx_session import integer_kernels, session_of
from msgs.files.shipped import WEIGHTS

def answer(name, cells):
    path = WEIGHTS / f"{name}.onnx"
    session = session_of(path, path.read_bytes(), 1)
    return session.run(None, {session.get_inputs()[0].name: cells})[0]

cells = np.load(sys.argv[1])
np.savez(sys.argv[2], **{name: answer(name, cells[name]) for name in cells.files})
print(integer_kernels().name)
"""


@pytest.fixture
def unknown_processor() -> Iterator[None]:
    integer_kernels.cache_clear()
    yield
    integer_kernels.cache_clear()


def fake_runtime(monkeypatch: pytest.MonkeyPatch, exact: set[str]) -> list[str]:
    """Let the probe be exact with the named kernels alone; return the kernels of the sessions that are opened."""
    opened: list[str] = []

    def session(model: bytes, options: onnxruntime.SessionOptions, providers: list[str]) -> SimpleNamespace:
        kernels = options.get_session_config_entry("session.x64quantprecision")
        if model is not onnx_session._PROBE:
            opened.append(kernels)
        return SimpleNamespace(get_inputs=list, run=lambda _, cells: [np.where(kernels in exact, cells["x"], 129)])

    monkeypatch.setattr(onnxruntime, "InferenceSession", session)
    return opened


@pytest.mark.usefixtures("unknown_processor")
def test_kernels_that_cut_sums_off_run_no_network(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    opened = fake_runtime(monkeypatch, {"1"})
    session_of(Path("whole.onnx"), b"...QuantizeLinear...", 1)
    session_of(Path("real.onnx"), b"...Conv...", 1)
    assert opened == ["1", "0"]
    assert [record.getMessage() for record in caplog.records] == [f"whole.onnx: {IntegerKernels.U8U8}"]


@pytest.mark.usefixtures("unknown_processor")
def test_exact_kernels_are_kept_for_they_are_faster(monkeypatch: pytest.MonkeyPatch) -> None:
    opened = fake_runtime(monkeypatch, {"0", "1"})
    session_of(Path("whole.onnx"), b"...QuantizeLinear...", 1)
    assert opened == ["0"]


@pytest.mark.usefixtures("unknown_processor")
def test_a_processor_without_exact_kernels_runs_no_int8_network(monkeypatch: pytest.MonkeyPatch) -> None:
    opened = fake_runtime(monkeypatch, set())
    with pytest.raises(ValueError, match="no int8 kernels with exact sums for this processor: use networks of fp32"):
        session_of(Path("whole.onnx"), b"...QuantizeLinear...", 1)
    session_of(Path("real.onnx"), b"...Conv...", 1)
    assert opened == ["0"]


def inputs(names: Iterable[str]) -> dict[str, np.ndarray]:
    """Return an input of each network, as loud as a map full of echoes: sums that could be cut off."""
    rng = np.random.default_rng(0)
    sessions = {name: onnxruntime.InferenceSession(WEIGHTS / f"{name}.onnx") for name in names}
    return {name: rng.random(session.get_inputs()[0].shape, np.float32) for name, session in sessions.items()}


# max: AVX2 without VNNI; Nehalem: SSE alone
@pytest.mark.parametrize(
    ("processor", "kernels", "names"), [("max", "U8U8", NETWORKS), ("Nehalem", "U8S8", ("compact_unet.near.int8",))]
)
def test_committed_networks_answer_the_same_on_an_emulated_processor(
    processor: str, kernels: str, names: tuple[str, ...], tmp_path: Path
) -> None:
    emulator = shutil.which("qemu-x86_64")
    if emulator is None or platform.machine() != "x86_64":
        pytest.skip("needs qemu-x86_64 (package qemu-user) on x86-64")
    cells = inputs(names)
    np.savez(tmp_path / "cells.npz", **cells)
    command = [emulator, "-cpu", processor, sys.executable, "-c", CHILD, tmp_path / "cells.npz", tmp_path / "there.npz"]
    said = subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True, timeout=300).stdout
    assert said.split() == [kernels]
    with np.load(tmp_path / "there.npz") as there:
        for name, values in cells.items():
            path = WEIGHTS / f"{name}.onnx"
            session = session_of(path, path.read_bytes(), 1)
            (here,) = session.run(None, {session.get_inputs()[0].name: values})
            as_shares = expit if name.startswith("object") else np.asarray
            np.testing.assert_allclose(as_shares(there[name]), as_shares(here), atol=0.01, err_msg=name)
