"""Scripts of the capture tool: the same chirps as a `.cfg` says, and every line that is not read refused by number."""

from __future__ import annotations

import pytest

from contrib.boards.dca1000_capture import parse_cfg
from contrib.boards.mmwave_studio import parse_lua
from tests.contrib.boards.test_import_dca1000 import CFG, SAMPLES

#: The chirps of `CFG`.
LUA = f"""-- two transmitters of a row take turns
--[[ a comment
over lines ]]
local SAMPLES = {SAMPLES} -- each chirp
LAST = 2 - 1
PATH = "C:\\\\ti\\\\firmware.bin" -- with -- two dashes
TEXT = 'a -- text'
ar1.FullReset()
ar1.Connect(7, 921600, 1000)
ar1.SelectChipVersion("XWR1642")
ar1.DownloadBSSFw(PATH)
ar1.ChanNAdcConfig(1, 1, 0, 1, 1, 1, 1, 2, 1, 0)
ar1.DataPathConfig(1, 1, 0)
ar1.LVDSLaneConfig(0, 1, 1, 0, 0, 1, 0, 0)
ar1.ProfileConfig(0, 77, 30, 6, 62, 0, 0, 0, 0, 0, 0,
                  60, 1, SAMPLES, 2.5 * 1e3, 0, 0, 30)
ar1.ChirpConfig(0, 0, 0, 0, 0, 0, 0, 1, 0, 0)
ar1.ChirpConfig(1, 1, 0, 0, 0, 0, 0, 0, 1, 0)
ar1.FrameConfig(0, LAST, 2, 32, (50 + -LAST * 10), 0, 0, 1)
ar1.SelectCaptureDevice("DCA1000")
ar1.CaptureCardConfig_Mode(1, 2, 1, 2, 3, 30)
RSTD.Sleep(1000); print("Chirps:", -LAST / 2)
"""


def test_a_script_says_what_a_cfg_says() -> None:
    script, lines = parse_lua(LUA, "a.lua"), parse_cfg(CFG, "a.cfg")
    for name in ("device", "channel", "adc", "profile", "chirps", "transmitters", "frame_shape"):
        assert getattr(script, name) == getattr(lines, name), name
    assert (script.frame.frames, script.frame.loops, script.frame.period_ms) == (2, 32, 40)
    assert parse_lua(LUA.replace("2, 1, 0)", "2, 1, 1)"), "a.lua").adcbuf is not None


@pytest.mark.parametrize(
    ("old", "new", "rule"),
    [
        (
            "LAST = 2 - 1",
            "if a == 0 then",
            "line 5: must be NAME = VALUE or NAME(VALUES) of at most 600 characters, got 'if a == 0 then'",
        ),
        ("LAST = 2 - 1", "for i = 1, 3 do", "line 5: must be NAME = VALUE"),
        ("LAST = 2 - 1", "LAST = #PATH", "line 5: must be NAME = VALUE"),
        ("LAST = 2 - 1", "LAST = [x for x in 2]", "line 5: must be a number, a text or a name given before"),
        ("LAST = 2 - 1", "LAST = 2 ** 9", "line 5: must be a number, a text or a name"),
        ("LAST = 2 - 1", "LAST = True", "line 5: must be a number, a text or a name"),
        ("LAST = 2 - 1", "LAST = OTHER", "line 5: must be a number, a text or a name given before, got 'OTHER'"),
        ("LAST = 2 - 1", "LAST = 'a' + 1", "line 5: must reckon with numbers, got 'a'"),
        ("LAST = 2 - 1", "LAST = 1 / 0", "line 5: must not divide by zero, got '1 / 0'"),
        ("LAST = 2 - 1", "LAST = 1e999", "line 5: must have finite numbers, got inf"),
        ("LAST = 2 - 1", "LAST = " + "9" * 400, "line 5: must have finite numbers, got inf"),
        ("LAST = 2 - 1", "LAST, B = 1, 2", "line 5: must be NAME = VALUE"),
        ("LAST = 2 - 1", "LAST = " + "(" * 9999 + "1" + ")" * 9999, "line 5: must be NAME = VALUE"),
        ("LAST = 2 - 1", "LAST = 1" + "+1" * 9999, "line 5: must be NAME = VALUE"),
        ("LAST = 2 - 1", "LAST = (1", "line 5: must be NAME = VALUE"),
        ("ar1.FullReset()", "os.execute('a')", "line 8: os.execute must be a call that is known"),
        ("ar1.FullReset()", "ar1.EnableTestSource(1)", "line 8: ar1.EnableTestSource must be a call that is known"),
        (
            "XWR1642",
            "AR1243",
            "must name a device of xwr14xx, xwr16xx, xwr18xx, awr2944, awrl6844, awr2243_cascade, got 'AR1243'",
        ),
        ("1, 1, 0, 1, 1, 1, 1, 2, 1, 0", "1, 1, 0, 1, 1, 1, 1, 2, 1", "must have 10 values, got 9"),
        ("1, 1, 0, 1, 1, 1, 1, 2, 1, 0", "1, 1, 0, 1, 1, 1, 3, 2, 1, 0", "switches must be 0 or 1, got 1, 1, 1, 3"),
        ("1, 1, 0, 1, 1, 1, 1, 2, 1, 0", "1, 1, 0, 1, 1, 1, 1, 1, 1, 0", "adc_bits must be 2 (16 bits), got 1"),
        ("DataPathConfig(1, 1, 0)", "DataPathConfig(1, 4, 0)", "value 2 must be 1 (ADC samples alone), got 4"),
        ("1, 1, 0, 0, 1, 0, 0)", "1, 1, 0, 0, 1, 0, 1)", "value 8 must be 0 (no checksums), got 1"),
        ("Mode(1, 2, 1", "Mode(1, 1, 1", "CaptureCardConfig_Mode must take 2 lanes of xwr16xx, got 4"),
        ("Mode(1, 2, 1", "Mode(1, 3, 1", "value 2 must be 1 (four lanes) or 2 (two), got 3"),
        ("LVDSLaneConfig(0, 1, 1,", "LVDSLaneConfig(0, 1, 0,", "sent_lanes must be 2 on xwr16xx, or 4 of which the"),
        ("LVDSLaneConfig(0, 1, 1,", "LVDSLaneConfig(0, 1, 7,", "switches must be 0 or 1, got 1, 7, 0, 0"),
        ("Mode(1, 2, 1, 2, 3, 30)", "Mode(2, 2, 1, 2, 3, 30)", "value 1 must be 1 (raw), got 2"),
        ("62, 0, 0, 0, 0, 0, 0", "62, 0, 3, 0, 0, 0, 0", "backoff must be that of all transmitters, got 0, 3, 0"),
        ("SelectCaptureDevice(", "SelectCaptureDevice(1, ", "value 1 must be 'DCA1000' (the card), got 1"),
        ("ar1.FrameConfig", "ar1.ChirpConfig", "must have 10 values, got 8"),
        ("print(", "ar1.SelectChipVersion('XWR1642') print(", "line 22: must be NAME = VALUE"),
        ("print(", "ar1.SelectChipVersion('XWR1642'); print(", "line 22: ar1.SelectChipVersion must stand once"),
        ("0, LAST, 2, 32,", "0, LAST, 2, 0,", "loops must be 1..65535, got 0"),
        ("0, LAST, 2, 32,", "0, TEXT, 2, 32,", "`$.frameCfg.chirp_end_index`, got 'a -- text'"),
        ('ar1.SelectChipVersion("XWR1642")', "", "device must be named, one of xwr14xx, xwr16xx, xwr18xx"),
    ],
)
def test_what_is_not_read_is_named(old: str, new: str, rule: str) -> None:
    assert old in LUA
    with pytest.raises(ValueError, match=r"^a\.lua: ") as refused:
        parse_lua(LUA.replace(old, new, 1), "a.lua")
    assert rule in str(refused.value)
    assert "\n" not in str(refused.value)
