"""Checkpoints of the published names, built by rule, into networks of ours."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from lab.networks.residual_reflect_net import ResidualReflectNet
from lab.networks.swin_unet import TABLE_3, SwinUNet, SwinUNetConfig
from lab.training.pretrained import interpolate_biases, load_initial

Shapes = dict[str, tuple[int, ...]]

#: Features of 16, 8, 4 and 2 cells a side, windows of 4, 4, 4 and 2: two stages are shifted.
SMALL = SwinUNetConfig(
    range_bins=64, columns=64, crop_columns=0, embed=8, depths=(2, 2, 2, 1), heads=(1, 2, 4, 8), window=(4, 4)
)


def block_shapes(prefix: str, width: int, heads: int, window: int, mask: int) -> Shapes:
    cells = window**2
    shapes: Shapes = {f"{prefix}attn_mask": (mask, cells, cells)} if mask else {}
    for norm in ("norm1", "norm2"):
        shapes |= {f"{prefix}{norm}.weight": (width,), f"{prefix}{norm}.bias": (width,)}
    shapes[f"{prefix}attn.relative_position_bias_table"] = ((2 * window - 1) ** 2, heads)
    shapes[f"{prefix}attn.relative_position_index"] = (cells, cells)
    for name, out, into in (("attn.qkv", 3, 1), ("attn.proj", 1, 1), ("mlp.fc1", 4, 1), ("mlp.fc2", 1, 4)):
        shapes |= {f"{prefix}{name}.weight": (out * width, into * width), f"{prefix}{name}.bias": (out * width,)}
    return shapes


def stage_shapes(prefix: str, config: SwinUNetConfig, stage: int, window: int, rows: int) -> Shapes:
    """Blocks of a stage with `rows` x `rows` features; windows shrink to them and odd blocks are masked."""
    window = min(window, rows)
    shapes: Shapes = {}
    for block in range(config.depths[stage]):
        mask = (rows // window) ** 2 if block % 2 and rows > window else 0
        shapes |= block_shapes(f"{prefix}blocks.{block}.", config.width_at(stage), config.heads[stage], window, mask)
    return shapes


def norm_shapes(name: str, width: int) -> Shapes:
    return {f"{name}.weight": (width,), f"{name}.bias": (width,)}


def encoder_shapes(config: SwinUNetConfig, window: int, rows: int) -> Shapes:
    width = config.embed
    shapes: Shapes = {"patch_embed.proj.weight": (width, 3, 4, 4), "patch_embed.proj.bias": (width,)}
    shapes |= norm_shapes("patch_embed.norm", width) | norm_shapes("norm", 8 * width)
    for stage in range(4):
        shapes |= stage_shapes(f"layers.{stage}.", config, stage, window, rows // 2**stage)
    for stage in range(3):
        wide = config.width_at(stage)
        shapes[f"layers.{stage}.downsample.reduction.weight"] = (2 * wide, 4 * wide)
        shapes |= norm_shapes(f"layers.{stage}.downsample.norm", 4 * wide)
    return shapes


def stage_1_shapes(config: SwinUNetConfig) -> Shapes:
    """The authors' first checkpoint: encoder, decoder and head of a square network."""
    width, window, rows = config.embed, config.window[0], config.range_bins // 4
    shapes = encoder_shapes(config, window, rows)
    for level, stage in ((1, 2), (2, 1), (3, 0)):
        wide = config.width_at(stage)
        shapes |= stage_shapes(f"layers_up.{level}.", config, stage, window, rows // 2**stage)
        shapes |= {f"concat_back_dim.{level}.weight": (wide, 2 * wide), f"concat_back_dim.{level}.bias": (wide,)}
        above = f"layers_up.{level - 1}." + ("upsample." if level > 1 else "")
        shapes[f"{above}expand.weight"] = (4 * wide, 2 * wide)
        shapes |= norm_shapes(f"{above}norm", wide)
    shapes |= norm_shapes("norm_up", width) | norm_shapes("up.norm", width)
    shapes |= {"up.expand.weight": (16 * width, width), "output.weight": (2, width, 1, 1)}
    return {f"swin_unet.{name}": shape for name, shape in shapes.items()}


def swin_t_shapes(config: SwinUNetConfig) -> Shapes:
    """The ImageNet checkpoint: window 7 on 56 x 56 tokens, a classifier of 1000."""
    return encoder_shapes(config, 7, 56) | {"head.weight": (1000, 8 * config.embed), "head.bias": (1000,)}


def stage_2_shapes() -> Shapes:
    widths = {
        "patch_encoder": (2, 64, 128, 128),
        "g_query_encoder": (2, 64, 128),
        "state_encoder": (6, 64, 64),
        "decoder": (192, 256, 128, 2),
    }
    shapes: Shapes = {}
    for name, sizes in widths.items():
        for layer in range(len(sizes) - 1):
            shapes[f"{name}.{2 * layer}.weight"] = (sizes[layer + 1], sizes[layer])
            shapes[f"{name}.{2 * layer}.bias"] = (sizes[layer + 1],)
    return shapes


def values_of(shapes: Shapes) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(0)
    return {name: 0.1 * torch.randn(shape, generator=generator) for name, shape in shapes.items()}


def is_derived(name: str) -> bool:
    return name.endswith(("relative_position_index", "attn_mask"))


def fresh(config: SwinUNetConfig = SMALL) -> SwinUNet:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    return SwinUNet(config).eval()


def answer(network: nn.Module) -> Tensor:
    with torch.no_grad():
        return network(torch.linspace(0.0, 1.0, 3 * 64 * 64).reshape(1, 3, 64, 64))


def save(path: Path, content: object) -> Path:
    torch.save(content, path)
    return path


def test_names_of_table_3_are_the_published_ones_one_to_one() -> None:
    """355 published entries, 33 of them derived; the other 322 have 41,392,932 numbers and our very shapes."""
    published = stage_1_shapes(TABLE_3)
    learned = {name.removeprefix("swin_unet."): shape for name, shape in published.items() if not is_derived(name)}
    with torch.device("meta"):
        ours = {name: tuple(tensor.shape) for name, tensor in SwinUNet(TABLE_3).state_dict().items()}
    assert (len(published), len(learned)) == (355, 322)
    assert learned == ours


def test_published_stage_1_fills_every_parameter(tmp_path: Path) -> None:
    tensors = values_of(stage_1_shapes(SMALL))
    network = fresh()
    before = answer(network)
    report = load_initial(network, save(tmp_path / "stage_1.pth", tensors))
    assert report.source == "published stage 1"
    assert len(report.loaded) + len(report.derived) == len(tensors)
    assert set(report.derived) == {name for name in tensors if is_derived(name)}
    assert (report.interpolated, report.unused, report.fresh) == ((), (), ())
    for name, tensor in network.state_dict().items():
        assert torch.equal(tensor, tensors[f"swin_unet.{name}"]), name
    assert not torch.allclose(answer(network), before, atol=1e-2)


def test_swin_t_fills_the_encoder_and_its_mirror(tmp_path: Path) -> None:
    """Stage i also starts decoder stage 3-i; tables of window 7 come to ours; the classifier stays out."""
    tensors = values_of(swin_t_shapes(SMALL))
    network = fresh()
    before, start = answer(network), {name: tensor.clone() for name, tensor in network.state_dict().items()}
    report = load_initial(network, save(tmp_path / "swin_t.pth", {"model": tensors}))
    state = network.state_dict()
    assert report.source == "Swin-T of ImageNet"
    assert report.unused == ("head.weight", "head.bias")
    assert set(report.derived) == {name for name in tensors if is_derived(name)}
    used = {name for name in tensors if name in report.loaded} | {*report.unused, *report.derived}
    assert used == set(tensors)
    assert {*report.loaded, *report.fresh} == set(state)
    for level, stage in ((1, 2), (2, 1), (3, 0)):
        for name in ("blocks.0.attn.qkv.weight", "blocks.1.mlp.fc2.bias"):
            assert torch.equal(state[f"layers_up.{level}.{name}"], tensors[f"layers.{stage}.{name}"])
    assert set(report.interpolated) == {name for name in state if name.endswith("relative_position_bias_table")}
    # window 7 to 4: the farthest offsets are the corners of both tables, the middle is no offset
    table, ours = tensors["layers.0.blocks.0.attn.relative_position_bias_table"], state[report.interpolated[0]]
    for theirs_at, ours_at in ((0, 0), (84, 24), (168, 48)):
        torch.testing.assert_close(ours[ours_at], table[theirs_at], atol=1e-6, rtol=1e-5)
    for name in report.fresh:
        assert torch.equal(state[name], start[name]), name
    assert {"output.weight", "up.expand.weight", "norm_up.bias", "concat_back_dim.1.weight"} < set(report.fresh)
    assert not torch.allclose(answer(network), before, atol=1e-3)


def test_biases_linear_in_the_offset_stay_linear() -> None:
    """A table a + b row + c column over offsets of window 7 becomes the same plane over the offsets of 8 x 5.

    torch's cubic kernel leaves a plane by up to 5 % of a step (0.02 here) and flattens near the edge, left out here;
    swapped axes or shifted nodes would miss by a step, 0.3. The centre is no offset in both.
    """
    offset = torch.linspace(-1.0, 1.0, 13)
    table = (0.5 + 2.0 * offset[:, None] - 3.0 * offset[None, :]).reshape(169, 1).expand(169, 2)
    grid = interpolate_biases(table, (15, 9)).reshape(15, 9, 2)
    wanted = 0.5 + 2.0 * torch.linspace(-1.0, 1.0, 15)[:, None] - 3.0 * torch.linspace(-1.0, 1.0, 9)[None, :]
    torch.testing.assert_close(grid[3:-3, 2:-2, 0], wanted[3:-3, 2:-2], atol=0.03, rtol=0.0)
    torch.testing.assert_close(grid[..., 0], grid[..., 1])
    assert grid[7, 4, 0].item() == pytest.approx(0.5, abs=1e-5)


def test_published_stage_2_fills_the_residual_network(tmp_path: Path) -> None:
    """120,706 parameters; the published query encoder is called g_query_encoder."""
    tensors = values_of(stage_2_shapes())
    network = ResidualReflectNet()
    report = load_initial(network, save(tmp_path / "stage_2.pth", tensors))
    assert report.source == "published stage 2"
    assert sum(tensor.numel() for tensor in tensors.values()) == 120_706
    assert len(report.loaded) == len(tensors)
    assert (report.derived, report.unused, report.fresh) == ((), (), ())
    for name, tensor in network.state_dict().items():
        assert torch.equal(tensor, tensors[name.replace("query_encoder", "g_query_encoder")]), name


@pytest.mark.parametrize("config", [SMALL, replace(SMALL, head_hidden=8)])
def test_own_run_goes_on_as_it_was(tmp_path: Path, config: SwinUNetConfig) -> None:
    trained = fresh(config)
    with torch.no_grad():
        for parameter in trained.parameters():
            parameter.add_(0.1)
    network = fresh(config)
    path = save(tmp_path / "best.pt", {"network": trained.state_dict(), "epoch": 3})
    report = load_initial(network, path)
    assert report.source == "own run"
    assert set(report.loaded) == set(network.state_dict())
    assert torch.equal(answer(network), answer(trained))


FIRST = "swin_unet.patch_embed.proj.weight"


def but_one(value: float) -> Tensor:
    """Zeros for the first tensor, one of its 384 numbers replaced."""
    tensor = torch.zeros(8, 3, 4, 4)
    tensor[5, 2, 1, 3] = value
    return tensor


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({FIRST: None}, r"1 missing \(patch_embed.proj.weight\)"),
        ({"swin_unet.more.weight": torch.zeros(2)}, r"1 foreign \(swin_unet.more.weight\)"),
        ({FIRST: torch.zeros(8, 5, 4, 4)}, r"1 of another shape \(.*proj.weight must be \(8, 3, 4, 4\), got \(8, 5"),
        ({FIRST: torch.full((8, 3, 4, 4), torch.nan)}, rf"1 not finite \({FIRST}\)"),
        ({FIRST: but_one(torch.nan)}, rf"1 not finite \({FIRST}\)"),
        ({FIRST: but_one(-torch.inf)}, rf"1 not finite \({FIRST}\)"),
        ({"swin_unet.layers.7.blocks.1.attn_mask": torch.zeros(4)}, r"1 foreign \(swin_unet.layers.7.blocks.1.attn"),
        (
            {f"swin_unet.{n}": torch.zeros(1) for n in "abcd"},
            r"4 foreign \(swin_unet.a, swin_unet.b, swin_unet.c, \.\.\.",
        ),
    ],
)
def test_a_wrong_tensor_is_refused_by_name_and_changes_nothing(
    tmp_path: Path, change: dict[str, Tensor | None], message: str
) -> None:
    merged = values_of(stage_1_shapes(SMALL)) | change
    path = save(tmp_path / "stage_1.pth", {name: tensor for name, tensor in merged.items() if tensor is not None})
    network = fresh()
    before = answer(network)
    with pytest.raises(ValueError, match=message):
        load_initial(network, path)
    assert torch.equal(answer(network), before)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"layers.1.blocks.1.attn.relative_position_bias_table": torch.zeros(168, 2)},
            r"must be \(49, 2\), got \(168, 2\)",
        ),
        (
            {"layers.1.blocks.1.attn.relative_position_bias_table": torch.zeros(169, 3)},
            r"must be \(49, 2\), got \(49, 3\)",
        ),
        ({"layers.3.downsample.norm.weight": torch.zeros(8)}, "1 foreign"),
        ({"norm.weight": None}, r"1 missing \(norm.weight\)"),
        (
            {"layers.0.blocks.1.norm1.bias": None},
            r"2 missing \(layers.0.blocks.1.norm1.bias, layers_up.3.blocks.1.norm1",
        ),
    ],
)
def test_a_wrong_swin_t_is_refused(tmp_path: Path, change: dict[str, Tensor | None], message: str) -> None:
    merged = values_of(swin_t_shapes(SMALL)) | change
    path = save(tmp_path / "swin_t.pth", {name: tensor for name, tensor in merged.items() if tensor is not None})
    with pytest.raises(ValueError, match=message):
        load_initial(fresh(), path)


def test_a_checkpoint_of_another_network_is_refused(tmp_path: Path) -> None:
    path = save(tmp_path / "stage_2.pth", values_of(stage_2_shapes()))
    with pytest.raises(
        ValueError, match=r"as published stage 2, got \d+ missing .*; 20 foreign \(patch_encoder.0.weight"
    ):
        load_initial(fresh(), path)


def test_files_that_hold_no_tensors_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"none.pth must be a checkpoint file: there is none"):
        load_initial(fresh(), tmp_path / "none.pth")
    (tmp_path / "text.pth").write_text("weights")
    with pytest.raises(ValueError, match=r"text.pth must be a checkpoint of tensors only"):
        load_initial(fresh(), tmp_path / "text.pth")
    with pytest.raises(ValueError, match="must hold named tensors, got list"):
        load_initial(fresh(), save(tmp_path / "list.pth", [torch.zeros(2)]))
    with pytest.raises(ValueError, match="must hold named tensors only, got int at 'epoch'"):
        load_initial(fresh(), save(tmp_path / "bare.pth", {"epoch": 3}))


def test_a_file_with_code_in_it_is_not_run(tmp_path: Path) -> None:
    """Objects other than tensors would need the file's own code: weights only."""
    path = save(tmp_path / "object.pth", {"network": SMALL})
    with pytest.raises(ValueError, match="must be a checkpoint of tensors only"):
        load_initial(fresh(), path)
