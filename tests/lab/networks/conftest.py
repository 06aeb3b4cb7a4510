from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch
from torch import Tensor, nn


@pytest.fixture
def onnx_difference(tmp_path: Path) -> Callable[..., float]:
    """Largest difference between torch and ONNX Runtime on given inputs, after an export with zeros."""

    def difference(net: nn.Module, *inputs: Tensor) -> float:
        net.eval()
        path = tmp_path / "network.onnx"
        with warnings.catch_warnings():
            # torch announces the successor of this exporter at every call
            warnings.simplefilter("ignore")
            examples = tuple(torch.zeros_like(x) for x in inputs)
            torch.onnx.export(net, examples, str(path), dynamo=False, opset_version=17)
        session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
        feed = {entry.name: x.numpy() for entry, x in zip(session.get_inputs(), inputs, strict=True)}
        with torch.no_grad():
            wanted = net(*inputs).numpy()
        answer = session.run(None, feed)[0]
        assert answer.shape == wanted.shape
        return float(np.abs(answer - wanted).max())

    return difference
