"""Sessions of ONNX Runtime on the vehicle: an int8 network answers the same on every processor."""

from __future__ import annotations

import base64
import hashlib
import logging
import zlib
from enum import Enum
from functools import cache
from pathlib import Path

import numpy as np
import onnxruntime

from models.perception.cards import read_learned
from msgs.files.unpacking import limited_memory

_LOG = logging.getLogger(__name__)
#: Errors that a session raises for bytes that are no network.
_NO_NETWORK = tuple(
    getattr(onnxruntime.capi.onnxruntime_pybind11_state, name)
    for name in ("Fail", "InvalidArgument", "InvalidGraph", "InvalidProtobuf", "NotImplemented", "RuntimeException")
)
#: No ONNX file holds more: it is one protobuf message.
MAX_MODEL_BYTES = (1 << 31) - 1
#: Memory that a network may take to be loaded and to run, beside eight times its file: those of this project take a
#: tenth, and a file of a hundred bytes may ask for all that there is.
MAX_RUN_BYTES = 1 << 30
#: ONNX Runtime logs what it also raises.
_FATAL_ONLY = 4
#: Parts of the names of integer operators, of which every int8 file holds one.
_INTEGER_OPERATORS = (b"QuantizeLinear", b"QLinear", b"Integer")
#: A `QLinearConv` of 16 channels whose weights are all 127 and whose output scale is 2032, so that an input of 255
#: gives 255; sums of two products that are cut off at 16 bits give 129.
_PROBE = zlib.decompress(
    base64.b85decode(
        "c-rIO5Mr=e!OW$>#aO|`Sj@#(#l=_-W@K_PmH@dzjFn2<fj*gesfk6-`FUkRj0IW~m^cK0kdcE?fZ2($+^d19euM)pZUIIo#$qoP28ITE2"
        "&V+Z`RAg=A;9FsSmnjY0Av9}D-+0yk_LvhkQkQ;2a}Kh7ZV2~5QAtI5KaP0R^pO$V&P&C-~|9PQkRD"
    )
)
_PROBE_SHAPE = (1, 16, 4, 4)


class IntegerKernels(Enum):
    """Kernels of int8 networks; the value is that of the runtime's option `session.x64quantprecision`."""

    #: Unsigned activations times signed weights, exact where the processor multiplies and adds into 32 bits (AVX-VNNI,
    #: AVX512-VNNI, AMX, NEON) or the kernel widens first (SSE).
    U8S8 = "0"
    #: Weights moved to unsigned numbers: exact everywhere, slower. For AVX2 and AVX512 without VNNI, whose kernels of
    #: the first kind cut sums of two products off at 16 bits.
    U8U8 = "1"

    def __str__(self) -> str:
        slower = ": those of U8S8, two to three times as fast, lose sums on this processor"
        return f"int8 kernels {self.name}{slower if self is IntegerKernels.U8U8 else ''}"


@cache
def integer_kernels() -> IntegerKernels:
    """Return the fastest kernels whose sums are exact on this processor, as a small network shows.

    Raises `ValueError` where none are: an int8 network would answer otherwise than it was validated.
    """
    for kernels in IntegerKernels:
        session = onnxruntime.InferenceSession(_PROBE, _options(1, kernels), providers=["CPUExecutionProvider"])
        if (session.run(None, {"x": np.full(_PROBE_SHAPE, 255, np.uint8)})[0] == 255).all():
            return kernels
    raise ValueError("onnxruntime has no int8 kernels with exact sums for this processor: use networks of fp32")


def open_session(model_path: Path, sha256: str, threads: int) -> onnxruntime.InferenceSession:
    """Return a session for a file with this checksum; raises `ValueError` naming the file."""
    model = read_learned(model_path, MAX_MODEL_BYTES)
    if wrong := wrong_checksum(model_path, model, sha256):
        raise ValueError(wrong[0])
    return session_of(model_path, model, threads)


def wrong_checksum(model_path: Path, model: bytes, sha256: str) -> list[str]:
    """Return what is wrong with the bytes of a file that should have a checksum."""
    actual = hashlib.sha256(model).hexdigest()
    return [] if actual == sha256 else [f"{model_path}: sha256 must be {sha256} as its card says, got {actual}"]


def session_of(model_path: Path, model: bytes, threads: int) -> onnxruntime.InferenceSession:
    """Return a session for the bytes of a file; raises `ValueError` naming the file.

    It has run once: it is warm, and what it allocates is within `MAX_RUN_BYTES`. The log says which kernels run an int8
    network.
    """
    kernels = IntegerKernels.U8S8
    if any(name in model for name in _INTEGER_OPERATORS):
        kernels = integer_kernels()
        _LOG.info("%s: %s", model_path.name, kernels)
    try:
        with limited_memory(MAX_RUN_BYTES + 8 * len(model)):
            session = onnxruntime.InferenceSession(
                model, _options(threads, kernels), providers=["CPUExecutionProvider"]
            )
            shapes = {each.name: each.shape for each in session.get_inputs() if each.type == "tensor(float)"}
            is_known = all(isinstance(size, int) for shape in shapes.values() for size in shape)
            if shapes and is_known and len(shapes) == len(session.get_inputs()):
                session.run(None, {name: np.zeros(shape, np.float32) for name, shape in shapes.items()})
            return session
    except (*_NO_NETWORK, MemoryError) as error:
        reason = " ".join(str(error).split())[:300] or type(error).__name__
        limit = f"it may take {MAX_RUN_BYTES >> 20} MiB to run"
        raise ValueError(f"{model_path} must be a whole ONNX file: {reason} ({limit})") from None


def _options(threads: int, kernels: IntegerKernels) -> onnxruntime.SessionOptions:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = _FATAL_ONLY
    # a spinning worker would keep its core from the other nodes between two maps
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.x64quantprecision", kernels.value)
    return options
