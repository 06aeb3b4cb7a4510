"""The networks that can be trained, by name, each with its input and its objective."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import msgspec
from torch import nn

from lab.networks import compact_unet, further_than_cfar, radar_tensor_network, swin_unet, unet
from lab.training.objectives.objectives import ObjectiveConfig
from models.perception.find.encoding import BOTH, CHANNELS, COMPLEX, LOG_MAGNITUDE, Encoding
from msgs.values.known_names import with_known_names

#: Input channels by name: those of the specification, of the released code, of both, and ours.
INPUTS: dict[str, tuple[str, ...]] = {
    "complex": COMPLEX,
    "log": LOG_MAGNITUDE,
    "both": BOTH,
    "levels": CHANNELS,
    "levels+complex": (*CHANNELS, "real", "imaginary"),
    "levels+phase": (*CHANNELS, "level_real", "level_imaginary"),
}


@dataclass(frozen=True)
class Family:
    """A kind of network: its configuration and module, its sizes by name, and its objective."""

    config: type
    module: type[nn.Module]
    sizes: dict[str, Any]
    objective: ObjectiveConfig = field(default_factory=ObjectiveConfig)
    #: Prefixes of the parameters of the head, which fine-tuning moves faster.
    head: tuple[str, ...] = ("head",)


FAMILIES: dict[str, Family] = {
    "compact_unet": Family(
        compact_unet.CompactUNetConfig,
        compact_unet.CompactUNet,
        {"compact": compact_unet.CompactUNetConfig(), "wide": compact_unet.WIDE, "fine": compact_unet.FINE},
    ),
    "unet": Family(unet.UNetConfig, unet.UNet, {"compact": unet.COMPACT, "full": unet.FULL}),
    "swin_unet": Family(
        swin_unet.SwinUNetConfig,
        swin_unet.SwinUNet,
        {"compact": swin_unet.COMPACT, "native": swin_unet.NATIVE, "full": swin_unet.TABLE_3},
        head=("output", "up"),
    ),
    "further_than_cfar": Family(
        further_than_cfar.FurtherThanCfarConfig,
        further_than_cfar.FurtherThanCfar,
        {"compact": further_than_cfar.COMPACT, "full": further_than_cfar.FULL},
        ObjectiveConfig(kind="binary_focal"),
    ),
    "radar_tensor_network": Family(
        radar_tensor_network.RadarTensorNetworkConfig,
        radar_tensor_network.RadarTensorNetwork,
        {"compact": radar_tensor_network.COMPACT, "full": radar_tensor_network.FULL},
        ObjectiveConfig(kind="anchors"),
        head=("classify", "locate"),
    ),
}


class NetworkChoice(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A network by its family and the fields of its configuration."""

    family: str
    config: dict[str, Any]

    def __post_init__(self) -> None:
        if self.family not in FAMILIES:
            raise ValueError(f"network must be one of {', '.join(FAMILIES)}, got {self.family!r}")

    @property
    def resolved(self) -> Any:
        """The family's configuration; raises `ValueError` if a field does not fit."""
        config_type = FAMILIES[self.family].config
        try:
            return msgspec.convert(self.config, config_type)
        except msgspec.ValidationError as error:
            raise ValueError(f"network {self.family}: {with_known_names(error, config_type)}") from None

    def build(self) -> nn.Module:
        """Return the network with fresh weights."""
        return FAMILIES[self.family].module(self.resolved)


def choice_of(family: str, config: Any) -> NetworkChoice:
    """Return a configuration of a family in the form of a file."""
    return NetworkChoice(family=family, config=msgspec.json.decode(msgspec.json.encode(config)))


def preset_network(family: str, size: str, inputs: str | None = None) -> tuple[NetworkChoice, Encoding]:
    """Return a network of one of a family's sizes and its encoding; raises `ValueError` listing the existing ones.

    `inputs` None: ours for `compact_unet`, that of the specification for all others.
    """
    if family not in FAMILIES:
        raise ValueError(f"network must be one of {', '.join(FAMILIES)}, got {family!r}")
    sizes = FAMILIES[family].sizes
    if size not in sizes:
        raise ValueError(f"size of {family} must be one of {', '.join(sizes)}, got {size!r}")
    name = inputs or ("levels+phase" if family == "compact_unet" else "complex")
    if name not in INPUTS:
        raise ValueError(f"input must be one of {', '.join(INPUTS)}, got {name!r}")
    config = replace(sizes[size], in_channels=len(INPUTS[name]))
    pad = getattr(config, "crop_columns", 0)
    encoding = Encoding(
        range_bins=config.range_bins, columns=config.columns - 2 * pad, channels=INPUTS[name], pad_columns=pad
    )
    return choice_of(family, config), encoding
