"""SwinUNet: the dense prediction module of the specification, Table 3, with its sizes as parameters.

Modules carry the names of the published checkpoints, so that `lab.training.pretrained` maps them one to one. Inside
the network features are [batch, rows, columns, channels]; rows are range, columns azimuth.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

STAGES = 4


@dataclass(frozen=True, kw_only=True)
class SwinUNetConfig:
    """Shape of a `SwinUNet`; defaults are Table 3: a 512 x 256 map of three channels, padded to a square."""

    in_channels: int = 3
    range_bins: int = 512
    columns: int = 512
    #: Padded columns on each side of the input that the output leaves out.
    crop_columns: int = 128
    classes: int = 2
    #: Rows and columns of a patch; the output gets them back.
    patch: tuple[int, int] = (4, 4)
    #: Channels after the patch embedding; each stage of the encoder doubles them.
    embed: int = 96
    #: Blocks of Enc-1, Enc-2, Enc-3 and the bottleneck; Dec-2, Dec-1 and Dec-0 mirror the first three.
    depths: tuple[int, int, int, int] = (2, 2, 6, 2)
    heads: tuple[int, int, int, int] = (3, 6, 12, 24)
    #: Rows and columns of an attention window, at most; see `window_at`.
    window: tuple[int, int] = (8, 8)
    mlp_ratio: int = 4
    #: Chance that the deepest block skips a sample in training; earlier blocks less, linearly.
    drop_path: float = 0.1
    #: 0 ends as Table 3 does. Otherwise an MLP of this hidden width turns each token into the logits of its patch: at
    #: full resolution, the final expansion and its normalisation take most of a small network's time.
    head_hidden: int = 0
    #: The published output convolution has no bias.
    output_bias: bool = False
    #: Mean logit of a fresh network: sigmoid(-2.19) = 0.1, for sparse targets.
    initial_logit: float = -2.19

    def __post_init__(self) -> None:
        rows, columns = (patch * 2 ** (STAGES - 1) for patch in self.patch)
        if self.range_bins % rows or self.columns % columns:
            raise ValueError(
                f"range_bins must be a multiple of {rows} and columns of {columns}, "
                f"got {self.range_bins} and {self.columns}"
            )
        if self.crop_columns % self.patch[1] or not 0 <= 2 * self.crop_columns < self.columns:
            raise ValueError(
                f"crop_columns must be a multiple of {self.patch[1]} below {self.columns // 2}, got {self.crop_columns}"
            )
        if not 0.0 <= self.drop_path < 1.0:
            raise ValueError(f"drop_path must be in [0, 1), got {self.drop_path}")
        if len(self.depths) != STAGES or min(self.depths) < 1:
            raise ValueError(f"depths must be {STAGES} counts of at least 1, got {self.depths}")
        if len(self.heads) != STAGES or any(self.width_at(s) % self.heads[s] for s in range(STAGES)):
            raise ValueError(
                f"heads must divide the widths {[self.width_at(s) for s in range(STAGES)]}, got {self.heads}"
            )
        for stage in range(STAGES):
            self._check_window(stage)

    def _check_window(self, stage: int) -> None:
        for size, window, limit in zip(self.size_at(stage), self.window_at(stage), self.window, strict=True):
            if 2 * window < min(size, limit):
                raise ValueError(f"window must tile the {size} cells of stage {stage} by at least half, got {limit}")

    @property
    def output_shape(self) -> tuple[int, int, int]:
        """(classes, range bins, columns) of the logits."""
        return self.classes, self.range_bins, self.columns - 2 * self.crop_columns

    def width_at(self, stage: int) -> int:
        """Return channels of the blocks at a stage, 0 (finest) to 3 (bottleneck)."""
        return self.embed * 2**stage

    def size_at(self, stage: int) -> tuple[int, int]:
        """Return (rows, columns) of the features at a stage."""
        return self.range_bins // (self.patch[0] * 2**stage), self.columns // (self.patch[1] * 2**stage)

    def window_at(self, stage: int) -> tuple[int, int]:
        """Return (rows, columns) of the windows at a stage: the largest that tile its features and are within `window`.

        Along an axis that one window covers, nothing is shifted.
        """
        rows, columns = self.size_at(stage)
        return _largest_divisor(rows, self.window[0]), _largest_divisor(columns, self.window[1])

    def drop_paths(self, stage: int) -> tuple[float, ...]:
        """Return the drop chance of each blockof a stage, from 0 in the network's first block to `drop_path`."""
        start, last = sum(self.depths[:stage]), max(sum(self.depths) - 1, 1)
        return tuple(self.drop_path * block / last for block in range(start, start + self.depths[stage]))


def _largest_divisor(size: int, limit: int) -> int:
    return max((n for n in range(1, limit + 1) if size % n == 0), default=1)


#: The specification's network, on maps padded by 128 columns on each side.
TABLE_3 = SwinUNetConfig()
#: The same parameters on the unpadded map: half the work.
NATIVE = SwinUNetConfig(columns=256, crop_columns=0)
#: 0.94 M parameters for one CPU core, on the range that streets need. Patches of 8 columns: the azimuth carries only 15
#: degrees of freedom, so 32 columns of tokens keep them all. The bottleneck is one window over the whole scene.
COMPACT = SwinUNetConfig(
    in_channels=5,
    range_bins=320,
    columns=256,
    crop_columns=0,
    patch=(4, 8),
    embed=24,
    depths=(2, 2, 2, 1),
    heads=(1, 2, 4, 8),
    window=(10, 8),
    mlp_ratio=2,
    drop_path=0.0,
    head_hidden=128,
)


def relative_position_index(window: tuple[int, int]) -> Tensor:
    """Return the row of the bias table for each query and key of a window, int64 [cells, cells]."""
    rows, columns = torch.meshgrid(torch.arange(window[0]), torch.arange(window[1]), indexing="ij")
    row_offset = rows.reshape(-1, 1) - rows.reshape(1, -1) + window[0] - 1
    column_offset = columns.reshape(-1, 1) - columns.reshape(1, -1) + window[1] - 1
    return row_offset * (2 * window[1] - 1) + column_offset


def shift_mask(size: tuple[int, int], window: tuple[int, int], shift: tuple[int, int]) -> Tensor:
    """Return a mask of pairs that must not attend to each other in shifted windows, bool [windows, cells, cells].

    A shift rolls the first rows and columns behind the last: cells on either side of that seam are no neighbours.
    """
    wrapped_rows = torch.arange(size[0]) >= size[0] - shift[0]
    wrapped_columns = torch.arange(size[1]) >= size[1] - shift[1]
    region = 2 * wrapped_rows[:, None] + 1 * wrapped_columns[None, :]
    # [windows, cells]
    region = to_windows(region[None, :, :, None], window)[0, :, :, 0]
    return region[:, :, None] != region[:, None, :]


def to_windows(x: Tensor, window: tuple[int, int]) -> Tensor:
    """Map [batch, rows, columns, channels] to [batch, windows, cells, channels]."""
    batch, rows, columns, channels = x.shape
    tiles = x.reshape(batch, rows // window[0], window[0], columns // window[1], window[1], channels)
    return tiles.transpose(2, 3).reshape(batch, -1, window[0] * window[1], channels)


def from_windows(x: Tensor, size: tuple[int, int], window: tuple[int, int]) -> Tensor:
    """Map [batch, windows, cells, channels] back to [batch, rows, columns, channels]."""
    batch, _, _, channels = x.shape
    tiles = x.reshape(batch, size[0] // window[0], size[1] // window[1], window[0], window[1], channels)
    return tiles.transpose(2, 3).reshape(batch, *size, channels)


class WindowAttention(nn.Module):
    """Attention inside each window, with a learned bias for each offset between two cells."""

    def __init__(self, width: int, heads: int, window: tuple[int, int], mask: Tensor) -> None:
        super().__init__()
        self.heads, self.window = heads, window
        offsets = (2 * window[0] - 1) * (2 * window[1] - 1)
        self.relative_position_bias_table = nn.Parameter(nn.init.trunc_normal_(torch.empty(offsets, heads), std=0.02))
        self.qkv = nn.Linear(width, 3 * width)
        self.proj = nn.Linear(width, width)
        self.register_buffer("relative_position_index", relative_position_index(window), persistent=False)
        self.register_buffer("mask", mask, persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        """Map [batch, windows, cells, width] to the same."""
        batch, windows, cells, width = x.shape
        # [3, batch, windows, heads, cells, width / heads]
        split = self.qkv(x).reshape(batch, windows, cells, 3, self.heads, -1).permute(3, 0, 1, 4, 2, 5)
        # windows and heads are one axis to the product: [batch, windows * heads, cells, width / heads]
        query, key, value = split.flatten(2, 3).unbind(0)
        logits = (query * query.shape[-1] ** -0.5) @ key.transpose(-2, -1) + self._bias().to(query.dtype)
        attended = (torch.softmax(logits, dim=-1) @ value).reshape(batch, windows, self.heads, cells, -1)
        return self.proj(attended.transpose(2, 3).reshape(batch, windows, cells, width))

    def _bias(self) -> Tensor:
        """Return the bias of the logits, [windows * heads, cells, cells]: a masked pair has no weight at all."""
        cells = self.window[0] * self.window[1]
        bias = self.relative_position_bias_table[self.relative_position_index.reshape(-1)]
        bias = bias.reshape(cells, cells, self.heads).permute(2, 0, 1)
        # [windows, heads, cells, cells]
        return bias[None].masked_fill(self.mask[:, None], float("-inf")).flatten(0, 1)


class Mlp(nn.Module):
    """Two linear layers around a GELU."""

    def __init__(self, width: int, hidden: int, out_width: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(width, hidden)
        self.fc2 = nn.Linear(hidden, out_width)

    def forward(self, x: Tensor) -> Tensor:
        """Map [..., width] to [..., out_width]."""
        return self.fc2(functional.gelu(self.fc1(x)))


class SwinBlock(nn.Module):
    """Attention in windows and an MLP, each normalised before and added; odd blocks of a stage shift the windows."""

    def __init__(self, config: SwinUNetConfig, stage: int, block: int) -> None:
        super().__init__()
        width = config.width_at(stage)
        self.size, self.window = config.size_at(stage), config.window_at(stage)
        self.shift = _shift(self.size, self.window) if block % 2 else (0, 0)
        self.drop_path = config.drop_paths(stage)[block]
        mask = shift_mask(self.size, self.window, self.shift)
        self.norm1 = nn.LayerNorm(width)
        self.attn = WindowAttention(width, config.heads[stage], self.window, mask)
        self.norm2 = nn.LayerNorm(width)
        self.mlp = Mlp(width, config.mlp_ratio * width, width)

    def forward(self, x: Tensor) -> Tensor:
        """Map [batch, rows, columns, width] to the same."""
        x = x + self._drop(self._attend(self.norm1(x)))
        return x + self._drop(self.mlp(self.norm2(x)))

    def _attend(self, x: Tensor) -> Tensor:
        rows, columns = self.shift
        if rows or columns:
            x = torch.roll(x, (-rows, -columns), dims=(1, 2))
        x = from_windows(self.attn(to_windows(x, self.window)), self.size, self.window)
        return torch.roll(x, self.shift, dims=(1, 2)) if rows or columns else x

    def _drop(self, branch: Tensor) -> Tensor:
        """Apply stochastic depth: in training a sample loses the branch by chance, the others compensate."""
        if not self.training or self.drop_path == 0.0:
            return branch
        kept = torch.rand(len(branch), 1, 1, 1, device=branch.device) >= self.drop_path
        return branch * (kept / (1.0 - self.drop_path)).to(branch.dtype)


def _shift(size: tuple[int, int], window: tuple[int, int]) -> tuple[int, int]:
    """Return half a window, none along an axis that one window covers."""
    return (window[0] // 2 if window[0] < size[0] else 0), (window[1] // 2 if window[1] < size[1] else 0)


class PatchEmbed(nn.Module):
    """Each patch of the input to one token."""

    def __init__(self, config: SwinUNetConfig) -> None:
        super().__init__()
        self.proj = nn.Conv2d(config.in_channels, config.embed, config.patch, stride=config.patch)
        self.norm = nn.LayerNorm(config.embed)

    def forward(self, x: Tensor) -> Tensor:
        """Map [batch, in_channels, range, columns] to [batch, rows, columns, embed]."""
        return self.norm(self.proj(x).permute(0, 2, 3, 1))


class PatchMerging(nn.Module):
    """Half the rows and columns, twice the channels."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(4 * width)
        self.reduction = nn.Linear(4 * width, 2 * width, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """Map [batch, rows, columns, width] to [batch, rows / 2, columns / 2, 2 * width]."""
        batch, rows, columns, width = x.shape
        # the four cells of a patch in the order (row, column) = (0, 0), (1, 0), (0, 1), (1, 1)
        patches = x.reshape(batch, rows // 2, 2, columns // 2, 2, width).permute(0, 1, 3, 4, 2, 5)
        return self.reduction(self.norm(patches.reshape(batch, rows // 2, columns // 2, 4 * width)))


class PatchExpand(nn.Module):
    """Each token to a tile of `factor` (rows, columns) tokens."""

    def __init__(self, width: int, out_width: int, factor: tuple[int, int] = (2, 2)) -> None:
        super().__init__()
        self.factor = factor
        self.expand = nn.Linear(width, factor[0] * factor[1] * out_width, bias=False)
        self.norm = nn.LayerNorm(out_width)

    def forward(self, x: Tensor) -> Tensor:
        """Map [batch, rows, columns, width] to [batch, rows * factor, columns * factor, out_width]."""
        return spread(self.tiles(x))

    def tiles(self, x: Tensor) -> Tensor:
        """Return the tokens before they are spread, [batch, rows, columns, *factor, out_width]."""
        return self.norm(self.expand(x).unflatten(-1, (*self.factor, -1)))


def spread(tiles: Tensor) -> Tensor:
    """Map [batch, rows, columns, tile rows, tile columns, width] to [batch, all rows, all columns, width]."""
    batch, rows, columns, tile_rows, tile_columns, width = tiles.shape
    return tiles.transpose(2, 3).reshape(batch, rows * tile_rows, columns * tile_columns, width)


class TileMlp(Mlp):
    """Each token to the logits of its patch."""

    def __init__(self, config: SwinUNetConfig) -> None:
        super().__init__(config.embed, config.head_hidden, config.patch[0] * config.patch[1] * config.classes)
        self.tile = (*config.patch, config.classes)

    def forward(self, x: Tensor) -> Tensor:
        """Map [batch, rows, columns, embed] to [batch, rows, columns, *patch, classes]."""
        return super().forward(x).unflatten(-1, self.tile)


class EncoderStage(nn.Module):
    """Swin blocks, then the merging of patches where a coarser stage follows."""

    def __init__(self, config: SwinUNetConfig, stage: int) -> None:
        super().__init__()
        self.blocks = nn.Sequential(*(SwinBlock(config, stage, block) for block in range(config.depths[stage])))
        self.downsample = PatchMerging(config.width_at(stage)) if stage < STAGES - 1 else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        """Map [batch, rows, columns, width] to [batch, rows / 2, columns / 2, 2 * width]."""
        return self.downsample(self.blocks(x))


class DecoderStage(nn.Module):
    """Swin blocks, then the expansion of patches where a finer stage follows."""

    def __init__(self, config: SwinUNetConfig, stage: int) -> None:
        super().__init__()
        width = config.width_at(stage)
        self.blocks = nn.Sequential(*(SwinBlock(config, stage, block) for block in range(config.depths[stage])))
        self.upsample = PatchExpand(width, width // 2) if stage else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        """Map [batch, rows, columns, width] to [batch, 2 * rows, 2 * columns, width / 2]."""
        return self.upsample(self.blocks(x))


class SwinUNet(nn.Module):
    """Encoded maps [batch, in_channels, range, columns] to logits [batch, *config.output_shape]. Source: Table 3."""

    def __init__(self, config: SwinUNetConfig | None = None) -> None:
        super().__init__()
        self.config = config = config or TABLE_3
        width = config.width_at
        self.patch_embed = PatchEmbed(config)
        self.layers = nn.ModuleList(EncoderStage(config, stage) for stage in range(STAGES))
        self.norm = nn.LayerNorm(width(3))
        self.layers_up = nn.ModuleList(
            [PatchExpand(width(3), width(2)), *(DecoderStage(config, stage) for stage in (2, 1, 0))]
        )
        self.concat_back_dim = nn.ModuleList(
            [nn.Identity(), *(nn.Linear(2 * width(stage), width(stage)) for stage in (2, 1, 0))]
        )
        self.norm_up = nn.LayerNorm(width(0))
        if config.head_hidden:
            self.up = TileMlp(config)
        else:
            self.up = PatchExpand(width(0), width(0), config.patch)
            self.output = nn.Conv2d(width(0), config.classes, 1, bias=config.output_bias)
        self.apply(_initialise)
        self._start_sparse()

    def forward(self, x: Tensor) -> Tensor:
        """Return logits of every cell of the output grid; the sizes beside the rows are those of Table 3."""
        # Input                                                        512 x 512 x 3
        embedded = self.patch_embed(x)  # Patch embed                  128 x 128 x 96
        enc_1 = self.layers[0](embedded)  # Enc-1                       64 x 64 x 192
        enc_2 = self.layers[1](enc_1)  # Enc-2                          32 x 32 x 384
        enc_3 = self.layers[2](enc_2)  # Enc-3                          16 x 16 x 768
        bottleneck = self.norm(self.layers[3](enc_3))  # Bottleneck     16 x 16 x 768
        x = self.layers_up[0](bottleneck)  # Dec-3                      32 x 32 x 384
        x = self.layers_up[1](self._join(1, x, enc_2))  # Dec-2         64 x 64 x 192
        x = self.layers_up[2](self._join(2, x, enc_1))  # Dec-1        128 x 128 x 96
        x = self.layers_up[3](self._join(3, x, embedded))  # Dec-0     128 x 128 x 96
        return self._project(self.norm_up(x))  # Output                512 x 512 x 2, less the padding

    def _join(self, level: int, x: Tensor, skip: Tensor) -> Tensor:
        """Return features and skip connection side by side, brought back to the width of one."""
        return self.concat_back_dim[level](torch.cat((x, skip), dim=-1))

    def _project(self, x: Tensor) -> Tensor:
        """Return final expansion and 1x1 convolution, [batch, rows, columns, embed] to the logits.

        Both act on each token alone: the padding is cut before them, and only the logits are spread.
        """
        crop = self.config.crop_columns // self.config.patch[1]
        x = x[:, :, crop : x.shape[2] - crop]
        if self.config.head_hidden:
            logits = self.up(x)
        else:
            logits = functional.linear(self.up.tiles(x), self.output.weight.flatten(1), self.output.bias)
        return spread(logits).permute(0, 3, 1, 2)

    def _start_sparse(self) -> None:
        """Let the mean logit start at `initial_logit`.

        Without an output bias the shift of the last normalisation replaces it: the shortest vector that the output
        weights map to that logit in every class.
        """
        logit = self.config.initial_logit
        if self.config.head_hidden:
            nn.init.constant_(self.up.fc2.bias, logit)
        elif self.config.output_bias:
            nn.init.constant_(self.output.bias, logit)
        else:
            weight = self.output.weight.detach().flatten(1)
            with torch.no_grad():
                self.up.norm.bias.copy_(torch.linalg.pinv(weight) @ torch.full((len(weight),), logit))


def _initialise(module: nn.Module) -> None:
    """Initialise linear layers small and without bias, as in the published Swin transformers."""
    if isinstance(module, nn.Linear):
        nn.init.trunc_normal_(module.weight, std=0.02)
        if module.bias is not None:
            nn.init.zeros_(module.bias)
