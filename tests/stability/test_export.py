"""Files that are not what they say: cut off, exchanged, of another shape, without a card; and extreme answers."""

from __future__ import annotations

from collections.abc import Callable
from hashlib import sha256
from pathlib import Path

import msgspec
import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper

from lab.networks.compact_unet import CompactUNet, CompactUNetConfig
from lab.training.export.onnx import Exported, export_onnx, parity, write_card
from lab.training.export.quantize import quantize_int8
from models.perception.find.encoding import Encoding
from models.perception.find.onnx_model import DensePredictor, ModelCard, card_path
from models.perception.onnx_session import session_of
from msgs.files.shipped import CHECKOUT
from msgs.values.radar import RangeAzimuthGrid
from tests.stability.catalogue import Errors

CONFIG = CompactUNetConfig(range_bins=32, columns=8, widths=(8, 16), attention_heads=2, attention_blocks=1)


@pytest.fixture(scope="module")
def network() -> CompactUNet:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    return CompactUNet(CONFIG).eval()


@pytest.fixture(scope="module")
def exported(network: CompactUNet, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("model") / "net.onnx"
    export_onnx(Exported(network), path)
    return path.read_bytes()


def put(path: Path, model: bytes) -> Path:
    """A file and the card that fits it."""
    path.write_bytes(model)
    card = ModelCard(
        name=path.stem,
        sha256=sha256(model).hexdigest(),
        parameters=1,
        encoding=Encoding(range_bins=32, columns=8),
        grid=RangeAzimuthGrid(range_bins=48, azimuth_bins=64),
        input_shape=(1, 5, 32, 8),
        output_shape=(1, 2, 32, 64),
        threshold=0.3,
        scores=(),
        data={},
        training={},
    )
    write_card(card, path)
    return path


def cut_with_its_card(model: Path) -> None:
    """Cut off before the card was written: the checksum holds, the file does not."""
    put(model, model.read_bytes()[:-1000])


def empty_with_its_card(model: Path) -> None:
    put(model, b"")


def cut_card(model: Path) -> None:
    card_path(model).write_bytes(card_path(model).read_bytes()[:200])


def card_with(**changes: object) -> Callable[[Path], None]:
    def change(model: Path) -> None:
        card = msgspec.json.decode(card_path(model).read_bytes())
        card_path(model).write_bytes(msgspec.json.encode(card | changes))

    return change


def network_of_another_type(model: Path) -> None:
    """Same shapes, but what goes in and comes out is float64."""
    ends = [
        helper.make_tensor_value_info(name, TensorProto.DOUBLE, shape)
        for name, shape in (("encoded", (1, 5, 32, 8)), ("confidence", (1, 2, 32, 64)))
    ]
    shape = helper.make_tensor("shape", TensorProto.INT64, [4], [1, 2, 32, 64])
    nodes = [
        helper.make_node("Concat", ["encoded"] * 4, ["wide"], axis=3),
        helper.make_node("Slice", ["wide", "from", "to", "axes"], ["cut"]),
        helper.make_node("Concat", ["cut"] * 2, ["whole"], axis=3),
        helper.make_node("Reshape", ["whole", "shape"], ["confidence"]),
    ]
    bounds = [helper.make_tensor(n, TensorProto.INT64, [1], [v]) for n, v in (("from", 0), ("to", 2), ("axes", 1))]
    graph = helper.make_graph(nodes, "other", ends[:1], ends[1:], [shape, *bounds])
    opset = [helper.make_opsetid("", 17)]
    put(model, helper.make_model(graph, opset_imports=opset, ir_version=8).SerializeToString())


def network_that_fills_the_memory(operator: str) -> Callable[[Path], None]:
    """A constant, or a repeated input, of 3 GiB in a file of some hundred bytes; its sum is added to the output."""

    def harm(model: Path) -> None:
        ends = [
            helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)
            for name, shape in (("encoded", (1, 5, 32, 8)), ("confidence", (1, 5, 32, 8)))
        ]
        repeats = (1, 1, 32_000, 25_000) if operator == "ConstantOfShape" else (1, 1, 1_000, 630)
        nodes = [
            helper.make_node(operator, ["encoded", "repeats"][operator == "ConstantOfShape" :], ["large"]),
            helper.make_node("ReduceMax", ["large"], ["sum"], keepdims=0),
            helper.make_node("Add", ["encoded", "sum"], ["confidence"]),
        ]
        shape = helper.make_tensor("repeats", TensorProto.INT64, [4], repeats)
        graph = helper.make_graph(nodes, "large", ends[:1], ends[1:], [shape])
        opset = [helper.make_opsetid("", 17)]
        put(model, helper.make_model(graph, opset_imports=opset, ir_version=8).SerializeToString())

    return harm


@pytest.mark.parametrize(
    ("harm", "message"),
    [
        (network_that_fills_the_memory("ConstantOfShape"), r"net\.onnx must be a whole .*may take 1024 MiB"),
        (network_that_fills_the_memory("Tile"), r"net\.onnx must be a whole .*may take 1024 MiB"),
        (cut_with_its_card, r"net\.onnx must be a whole ONNX file: .*"),
        (empty_with_its_card, r"net\.onnx must be a whole ONNX file: .*"),
        (cut_card, r"net\.json: Input data was truncated"),
        (
            card_with(encoding={"channels": ["level", "warmth"]}),
            r"net\.json: encoding: encoding\.channels must be .*'warmth'",
        ),
        (
            card_with(encoding={"range_bins": -1}),
            r"net\.json: encoding: encoding\.range_bins must be finite and positive, got -1",
        ),
        (card_with(grid={"azimuth_bins": 60}), r"net\.json: grid\.azimuth_bins must be a multiple of 16, got 60"),
        (network_of_another_type, r"net\.onnx: input must be one float32 array, got \['tensor\(double\)'\]"),
    ],
)
def test_what_does_not_belong_together_is_refused(
    exported: bytes, tmp_path: Path, harm: Callable[[Path], None], message: str
) -> None:
    """One line that names the file and what is wrong with it."""
    model = put(tmp_path / "net.onnx", exported)
    DensePredictor(model)
    harm(model)
    with pytest.raises(ValueError, match=message) as caught:
        DensePredictor(model)
    assert "\n" not in str(caught.value)


@pytest.mark.slow
@pytest.mark.parametrize("logit", [-1e4, 1e4])
def test_sure_answers_stay_probabilities_in_every_precision(network: CompactUNet, tmp_path: Path, logit: float) -> None:
    """A head that says the same everywhere: exp(1e4) leaves every float, 1e4 and its sum still fit float16."""
    sure = Exported(network)
    weight, bias = sure.network.head.weight.detach().clone(), sure.network.head.bias.detach().clone()
    torch.nn.init.zeros_(network.head.weight)
    torch.nn.init.constant_(network.head.bias, logit)
    try:
        paths = [tmp_path / f"{name}.onnx" for name in ("fp32", "fp16", "int8")]
        export_onnx(sure, paths[0])
        export_onnx(Exported(network, half=True), paths[1])
        quantize_int8(paths[0], paths[2], np.zeros((1, 5, 32, 8), np.float32))
        assert max(parity(sure, path) for path in paths) <= 1e-6
    finally:
        with torch.no_grad():
            network.head.weight.copy_(weight)
            network.head.bias.copy_(bias)


def test_calibration_on_empty_maps_leaves_a_network_that_answers(exported: bytes, tmp_path: Path) -> None:
    """Maps of zeros give ranges of no width; the file must load and answer numbers in 0..1 all the same."""
    source, target = tmp_path / "fp32.onnx", tmp_path / "int8.onnx"
    source.write_bytes(exported)
    quantize_int8(source, target, np.zeros((2, 5, 32, 8), np.float32))
    predictor = DensePredictor(put(tmp_path / "net.onnx", target.read_bytes()))
    for scale in (0.0, 1.0, 1e30):
        answer = predictor.infer(np.full((5, 32, 8), scale, np.float32))
        assert ((answer >= 0.0) & (answer <= 1.0)).all()


def test_files_hold_no_path_of_the_machine_that_wrote_them(exported: bytes) -> None:
    root = str(CHECKOUT).encode()
    assert root not in exported
    assert all(not node.doc_string for node in onnx.load_from_string(exported).graph.node)


@pytest.mark.hard("models.perception.onnx_session", "pairs of products added up in 16 bits", 0.0, "steps of 8 bits",
                  "integers are exact")  # fmt: skip
def test_sums_of_integer_products_are_exact_on_this_processor(errors: Errors) -> None:
    """16 products of 255 and 127: two of them pass 32,767, where the fast kernels of AVX2 cut them off."""
    products = np.full(16, 255 * 127)
    pairs = np.clip(products[::2] + products[1::2], -(1 << 15), (1 << 15) - 1)
    exact, scale = products.sum(), 16 * 127
    constants = {
        "weights": np.full((16, 16, 1, 1), 127, np.int8), "unit": np.float32(1.0), "scale": np.float32(scale),
        "zero": np.uint8(0), "middle": np.int8(0),
    }  # fmt: skip
    graph = helper.make_graph(
        [helper.make_node("QLinearConv", ["x", "unit", "zero", "weights", "unit", "middle", "scale", "zero"], ["y"])],
        "sums",
        [helper.make_tensor_value_info("x", TensorProto.UINT8, (1, 16, 4, 4))],
        [helper.make_tensor_value_info("y", TensorProto.UINT8, (1, 16, 4, 4))],
        [onnx.numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    session = session_of(Path("sums.onnx"), model.SerializeToString(), 1)
    (answer,) = session.run(None, {"x": np.full((1, 16, 4, 4), 255, np.uint8)})
    naive, ours = np.array([round(pairs.sum() / scale)]), answer.astype(int)
    errors(naive=np.abs(naive - exact / scale).max(), ours=np.abs(ours - exact / scale).max())
