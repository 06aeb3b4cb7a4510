"""Networks by family and size, and the encoding each takes."""

from __future__ import annotations

import pytest

from lab.training.map_networks import FAMILIES, INPUTS, preset_network

SIZES = [(family, size) for family in FAMILIES for size in FAMILIES[family].sizes]


@pytest.mark.parametrize(("family", "size"), SIZES)
def test_the_encoding_fills_the_networks_input(family: str, size: str) -> None:
    """Columns of the map and padding to both sides are as many as the network takes, channels and ranges too."""
    choice, encoding = preset_network(family, size)
    config = choice.resolved
    assert encoding.columns + 2 * encoding.pad_columns == config.columns
    assert encoding.range_bins == config.range_bins
    assert len(encoding.channels) == config.in_channels
    assert encoding.channels == INPUTS["levels+phase" if family == "compact_unet" else "complex"]


def test_a_padded_network_sees_the_map_in_its_middle() -> None:
    """Swin-UNet of Table 3 takes 512 columns and crops 128 to either side: 256 are the map's."""
    _, encoding = preset_network("swin_unet", "full")
    assert (encoding.columns, encoding.pad_columns) == (256, 128)


def test_the_input_asked_for_is_taken_and_others_are_refused() -> None:
    choice, encoding = preset_network("unet", "compact", "log")
    assert encoding.channels == INPUTS["log"] != INPUTS["complex"]
    assert choice.resolved.in_channels == len(INPUTS["log"])
    for arguments, says in (
        (("lenet", "compact"), "network must be one of compact_unet, unet, swin_unet, .*got 'lenet'"),
        (("unet", "tiny"), "size of unet must be one of compact, full, got 'tiny'"),
        (("unet", "compact", "sound"), "input must be one of .*, got 'sound'"),
    ):
        with pytest.raises(ValueError, match=says):
            preset_network(*arguments)
