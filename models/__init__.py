"""Floor 2, what is known: physics, vehicle, perception. Knows no bus, no clock, no socket."""

import os

from msgs.files.former_modules import know_former_names

# before ONNX Runtime is imported, which would keep a number of the machine and report what it runs
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
know_former_names()
