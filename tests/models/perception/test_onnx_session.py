"""int8 networks answer the same on every processor with AVX2; on others floats are rounded otherwise."""

from __future__ import annotations

import os
import platform
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx
import pytest
from scipy.special import expit

from models.perception import onnx_session
from models.perception.onnx_session import session_of
from msgs.files.shipped import WEIGHTS

NETWORKS = ("compact_unet.int8", "evidence_unet.int8", "field_unet.int8")
ROOT = Path(__file__).parents[3]
#: Writes the answers of the networks of a folder to the inputs of a file; each runs once, unlike in `session_of`.
CHILD = """
import sys
from pathlib import Path
import numpy as np
import onnxruntime
from models.perception.onnx_session import _options

def answer(name, cells):
    model = (Path(sys.argv[1]) / f"{name}.onnx").read_bytes()
    session = onnxruntime.InferenceSession(model, _options(1), providers=["CPUExecutionProvider"])
    return session.run(None, {session.get_inputs()[0].name: cells})[0]

cells = np.load(Path(sys.argv[1]) / "cells.npz")
np.savez(Path(sys.argv[1]) / "there.npz", **{name: answer(name, cells[name]) for name in cells.files})
"""
#: Cells a side of the network that takes maps of any size: each of its sums is the same on a small one.
SIDE = 16


def model_of(name: str) -> bytes:
    """A committed network; of the one of convolutions alone, the same for a small map."""
    model = onnx.load(WEIGHTS / f"{name}.onnx")
    if name.startswith("evidence"):
        del model.graph.value_info[:]
        for tensor in (*model.graph.input, *model.graph.output):
            for side in tensor.type.tensor_type.shape.dim[-2:]:
                side.dim_value = SIDE
    data: bytes = model.SerializeToString()
    return data


#: Largest differences on ARM: QLinearAdd rounds otherwise in 3 of 100,000 sums, and what follows carries it on. The
#: field network answers in steps of 0.148.
ON_ARM = {"evidence_unet.int8": 0.03, "field_unet.int8": 0.3}


# max: AVX2 without VNNI; Nehalem: SSE alone
@pytest.mark.parametrize(("processor", "names"), [("max", NETWORKS), ("Nehalem", ("compact_unet.int8",))])
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
    sessions, rng = {}, np.random.default_rng(0)
    for name in names:
        (folder / f"{name}.onnx").write_bytes(model_of(name))
        sessions[name] = session_of(folder / f"{name}.onnx", model_of(name), 1)
    # as loud as a map full of echoes: sums that could be cut off
    cells = {name: rng.random(one.get_inputs()[0].shape, np.float32) for name, one in sessions.items()}
    np.savez(folder / "cells.npz", **cells)  # type: ignore[arg-type]
    # the other processor runs its own kernels, not those that this one was told to
    environment = {name: value for name, value in os.environ.items() if name != "OPENBLAS_CORETYPE"}
    subprocess.run([*python, "-c", CHILD, folder], cwd=ROOT, env=environment, check=True, timeout=600)
    with np.load(folder / "there.npz") as there:
        for name, session in sessions.items():
            (here,) = session.run(None, {session.get_inputs()[0].name: cells[name]})
            as_shares = expit if name.startswith("evidence") else np.asarray
            tolerance = tolerances.get(name, 0.01)
            np.testing.assert_allclose(as_shares(there[name]), as_shares(here), atol=tolerance, err_msg=name)


def test_a_network_may_not_run_without_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A loop of 10^18 rounds in 200 bytes."""
    scalar = [onnx.helper.make_tensor_value_info(name, kind, []) for name, kind in (("i", 7), ("c", 9), ("a", 1))]
    ends = [onnx.helper.make_tensor_value_info(name, kind, None) for name, kind in (("d", 9), ("b", 1))]
    steps = [onnx.helper.make_node("Identity", ["c"], ["d"]), onnx.helper.make_node("Neg", ["a"], ["b"])]
    body = onnx.helper.make_graph(steps, "body", scalar, ends)
    start = [onnx.numpy_helper.from_array(np.array(10**18), "n"), onnx.numpy_helper.from_array(np.array(True), "t")]
    loop = onnx.helper.make_node("Loop", ["n", "t", "x"], ["y"], body=body)
    x, y = (onnx.helper.make_tensor_value_info(name, 1, []) for name in "xy")
    graph = onnx.helper.make_graph([loop], "endless", [x], [y], start)
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=8)
    monkeypatch.setattr(onnx_session, "MAX_RUN_S", 0.5)
    with pytest.raises(
        ValueError, match=r"endless\.onnx must be a whole ONNX file: .*terminate.*0\.5 s of processor time"
    ):
        session_of(tmp_path / "endless.onnx", model.SerializeToString(), 1)


@pytest.mark.parametrize("module", ["models.perception.find.onnx_model", "lab.training.export.onnx"])
def test_the_runtime_reports_nothing(tmp_path: Path, module: str) -> None:
    """It would keep a number of the machine and a queue of reports in the user's home."""
    home = {"HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path / "cache"), "PATH": os.environ["PATH"]}
    subprocess.run([sys.executable, "-c", f"import {module}"], cwd=ROOT, env=home, check=True)
    assert not list(tmp_path.rglob("*onnxruntime*"))
