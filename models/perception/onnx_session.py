"""Sessions of ONNX Runtime on the vehicle."""

from __future__ import annotations

import contextlib
import hashlib
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Generic, TypeVar

import msgspec
import numpy as np
import onnxruntime

from models.perception.cards import card_path, read_card, read_learned
from models.perception.trained_radar import TrainedRadar
from msgs.files.unpacking import limited_memory

#: Errors that a session raises for bytes that are no network.
_NO_NETWORK = tuple(
    getattr(onnxruntime.capi.onnxruntime_pybind11_state, name)
    for name in (
        *("Fail", "InvalidArgument", "InvalidGraph", "InvalidProtobuf", "ModelLoadCanceled", "NotImplemented"),
        "RuntimeException",
    )
)
#: No ONNX file holds more: it is one protobuf message.
MAX_MODEL_BYTES = (1 << 31) - 1
#: Memory that a network may take to be loaded and to run, beside eight times its file: those of this project take a
#: tenth, and a file of a hundred bytes may ask for all that there is.
MAX_RUN_BYTES = 1 << 30
#: Processor time that it may take for both: those of this project take seconds.
MAX_RUN_S = 60.0
#: ONNX Runtime logs what it also raises.
_FATAL_ONLY = 4


def open_session(model_path: Path, sha256: str, threads: int) -> onnxruntime.InferenceSession:
    """Return a session for a file with this checksum; raises `ValueError` naming the file."""
    model = read_learned(model_path, MAX_MODEL_BYTES)
    if wrong := wrong_checksum(model_path, model, sha256):
        raise ValueError(wrong[0])
    return session_of(model_path, model, threads)


class ArrayCard(msgspec.Struct, frozen=True, kw_only=True):
    """Description of a network file: how it was made, its input, its scores; a JSON file beside it."""

    name: str
    sha256: str
    parameters: int
    #: Radar of the maps in training.
    radar: TrainedRadar = TrainedRadar()
    input_shape: tuple[int, ...]
    output_shape: tuple[int, ...]
    #: On the data sets of validation.
    scores: dict[str, float] = {}
    #: Data sets of training and validation; networks before this one with their SHA-256.
    data: dict[str, str] = {}
    #: Chosen epoch and the resolved configuration of the run.
    training: dict[str, Any] = {}

    def check_shapes(self, **expected: tuple[int, ...]) -> None:
        """Raise `ValueError` where `input` or `output` is of another shape."""
        for end, shape in expected.items():
            if getattr(self, f"{end}_shape") != shape:
                raise ValueError(f"card.{end}_shape must be {shape}, got {getattr(self, f'{end}_shape')}")


Card = TypeVar("Card", bound=ArrayCard)


class ArraySession(Generic[Card]):
    """A network of one array in, one out, one input at a time; `ValueError` when its file and card do not agree."""

    def __init__(self, model_path: Path, kind: type[Card], threads: int) -> None:
        if threads < 1:
            raise ValueError(f"threads must be at least 1, got {threads}")
        self.card = read_card(card_path(model_path), kind)
        self._path, self._session = model_path, open_session(model_path, self.card.sha256, threads)
        expected = [self.card.input_shape, self.card.output_shape]
        actual = [tuple(tensor.shape) for tensor in (*self._session.get_inputs(), *self._session.get_outputs())]
        if actual != expected:
            raise ValueError(f"{model_path}: input and output of the network must be {expected}, got {actual}")

    def answer(self, inputs: np.ndarray) -> np.ndarray:
        """Return what the network says of one input as it is; `ValueError` for what is not finite."""
        answer: np.ndarray = self._session.run(None, {self._session.get_inputs()[0].name: inputs[None]})[0][0]
        if not np.isfinite(answer).all():
            raise ValueError(f"{self._path}: answers must be finite, got {np.extract(~np.isfinite(answer), answer)[0]}")
        return answer

    def looked(
        self, inputs: np.ndarray, mirrored: Callable[[], np.ndarray], odd: list[int], is_turned: bool, both: bool
    ) -> np.ndarray:
        """Return the answer to inputs, or, where they are turned, to their mirror image, mirrored back; or the mean.

        `odd`: answers that change sign when left and right are exchanged.
        """
        if not (both or is_turned):
            return self.answer(inputs)
        turned = self.answer(mirrored())[..., ::-1].copy()
        turned[odd] *= -1.0
        return 0.5 * (self.answer(inputs) + turned) if both else turned


def wrong_checksum(model_path: Path, model: bytes, sha256: str) -> list[str]:
    """Return what is wrong with the bytes of a file that should have a checksum."""
    actual = hashlib.sha256(model).hexdigest()
    return [] if actual == sha256 else [f"{model_path}: sha256 must be {sha256} as its card says, got {actual}"]


def session_of(model_path: Path, model: bytes, threads: int) -> onnxruntime.InferenceSession:
    """Return a warm session of a file's bytes, within `MAX_RUN_BYTES` and `MAX_RUN_S`; `ValueError` names the file."""
    try:
        with limited_memory(MAX_RUN_BYTES + 8 * len(model)):
            return _warm_session(model, threads)
    except (*_NO_NETWORK, MemoryError) as error:
        reason = " ".join(str(error).split())[:300] or type(error).__name__
        limit = f"it may take {MAX_RUN_BYTES >> 20} MiB and {MAX_RUN_S:g} s of processor time to run"
        raise ValueError(f"{model_path} must be a whole ONNX file: {reason} ({limit})") from None


def _warm_session(model: bytes, threads: int) -> onnxruntime.InferenceSession:
    options, run = _options(threads), onnxruntime.RunOptions()
    with _stopped_after(MAX_RUN_S, lambda: options.set_load_cancellation_flag(True), lambda: _terminate(run)):
        session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
        shapes = {each.name: each.shape for each in session.get_inputs() if each.type == "tensor(float)"}
        is_known = all(isinstance(size, int) for shape in shapes.values() for size in shape)
        if shapes and is_known and len(shapes) == len(session.get_inputs()):
            session.run(None, {name: np.zeros(shape, np.float32) for name, shape in shapes.items()}, run)
    return session


def _terminate(run: onnxruntime.RunOptions) -> None:
    run.terminate = True


@contextlib.contextmanager
def _stopped_after(cpu_s: float, *stops: Callable[[], None]) -> Iterator[None]:
    """Call `stops` once the body has taken so much processor time: loops and nested functions have no end."""
    is_done, end_s = threading.Event(), time.process_time() + cpu_s

    def watch() -> None:
        while not is_done.wait(0.2):
            if time.process_time() > end_s:
                for stop in stops:
                    stop()
                return

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield
    finally:
        is_done.set()
        watcher.join()


def _options(threads: int) -> onnxruntime.SessionOptions:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = _FATAL_ONLY
    # a spinning worker would keep its core from the other nodes between two maps
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    return options
