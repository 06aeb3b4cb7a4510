"""A detector of your own as an ONNX file with its card: python make_detector.py [DIR].

A network without training. A cell is a return if it stands out of the noise, is the strongest of its surroundings, and
is no side lobe of another direction; a return behind another one is mirrored. Nothing of mirrorwave is imported: numpy,
onnx and a card in JSON are all it takes.
"""

import hashlib
import json
import sys
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

#: Cells of the map that the network sees, nearest first, and cells of the whole map.
RANGE_BINS, AZIMUTHS, MAP_BINS = 320, 256, 512
RANGE_BIN_M = 0.21413747
#: Inputs, in this order. A level of 0..1 is -5..85 dB over the noise; contrast is the level under the strongest of the
#: same range. docs/guides/own-parts.md lists all.
CHANNELS = ["level", "contrast"]
DB = 1.0 / 90.0
#: 23 dB over the noise, 22 dB under the strongest of the range: a score of one half; 5 dB more make it 0.8.
MIDDLE = np.array([28.0 * DB, -22.0 * DB], np.float32)
STEEPNESS = np.array([25.0, 25.0], np.float32)
#: Surroundings of a cell: half a metre either way, and a beam.
SURROUNDINGS = [5, 21]
#: Behind: 4..34 m further away within 1.5 degrees.
NEAREST, FURTHEST, ACROSS = 19, 160, 7


def network() -> onnx.ModelProto:
    """Return the network: encoded map [1, 2, range, azimuth] -> scores of direct and mirrored returns, as large."""
    numbers = {
        "weights": np.diag(STEEPNESS)[:, :, None, None],
        "bias": -STEEPNESS * MIDDLE,
        "one": np.array(1.0, np.float32),
        "nearer": np.array([0, 0, FURTHEST, 0, 0, 0, -NEAREST, 0]),
    }
    half = [size // 2 for size in SURROUNDINGS]
    behind = {"kernel_shape": [FURTHEST - NEAREST + 1, ACROSS], "pads": [0, ACROSS // 2, 0, ACROSS // 2]}
    nodes = [
        helper.make_node("Conv", ["encoded", "weights", "bias"], ["logits"]),
        helper.make_node("Sigmoid", ["logits"], ["shares"]),
        helper.make_node("Split", ["shares"], ["stands_out", "no_side_lobe"], axis=1, num_outputs=2),
        helper.make_node("MaxPool", ["stands_out"], ["highest"], kernel_shape=SURROUNDINGS, pads=half + half),
        helper.make_node("Equal", ["stands_out", "highest"], ["is_highest"]),
        helper.make_node("Cast", ["is_highest"], ["maximum"], to=TensorProto.FLOAT),
        helper.make_node("Mul", ["stands_out", "no_side_lobe"], ["likely"]),
        helper.make_node("Mul", ["likely", "maximum"], ["detection"]),
        # the strongest detection NEAREST..FURTHEST bins nearer
        helper.make_node("Pad", ["detection", "nearer"], ["shifted"]),
        helper.make_node("MaxPool", ["shifted"], ["behind"], **behind),
        helper.make_node("Sub", ["one", "behind"], ["in_front"]),
        helper.make_node("Concat", ["in_front", "behind"], ["classes"], axis=1),
        helper.make_node("Mul", ["detection", "classes"], ["confidence"]),
    ]
    shapes = {"encoded": [1, len(CHANNELS), RANGE_BINS, AZIMUTHS], "confidence": [1, 2, RANGE_BINS, AZIMUTHS]}
    ends = [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in shapes.items()]
    constants = [numpy_helper.from_array(value, name) for name, value in numbers.items()]
    graph = helper.make_graph(nodes, "my_detector", ends[:1], ends[1:], constants)
    # a version of the file format that older runtimes read, too
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=8)
    onnx.checker.check_model(model, full_check=True)
    return model


def main(folder: Path) -> None:
    """Write my_detector.onnx and my_detector.json."""
    folder.mkdir(parents=True, exist_ok=True)
    content = network().SerializeToString()
    card = {
        "name": "my_detector",
        "sha256": hashlib.sha256(content).hexdigest(),
        "encoding": {"range_bins": RANGE_BINS, "columns": AZIMUTHS, "channels": CHANNELS},
        "grid": {"range_bin_m": RANGE_BIN_M, "range_bins": MAP_BINS, "azimuth_bins": AZIMUTHS},
        "input_shape": [1, len(CHANNELS), RANGE_BINS, AZIMUTHS],
        "output_shape": [1, 2, RANGE_BINS, AZIMUTHS],
        "threshold": 0.4,
    }
    (folder / "my_detector.onnx").write_bytes(content)
    (folder / "my_detector.json").write_text(json.dumps(card, indent=1))


if __name__ == "__main__":
    main(Path(*sys.argv[1:2]))
