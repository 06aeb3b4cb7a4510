"""The losses of all profiles, from a report of `mirrorwave eval --objects`, for `launch --latency-budget-ms`.

Writes docs/results/profiles.json: each profile with its present parameters and its mean loss over the report's sets.
Usage: mirrorwave eval --objects --set validation --set validation_moving --profile default --profile accurate
       --profile cfar --out runs/profiles
       python -m benchmarks.accuracy.profile_losses runs/profiles/results.json
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from lab.tradeoff.latency_budget import COMMITTED, ProfileLoss, ProfileLosses
from lab.tradeoff.rows import profile_setting
from msgs.files.checksums import json_lines
from msgs.files.whole_files import write_whole


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("report", type=Path)
    report = json.loads(parser.parse_args().report.read_text())
    command = " ".join(
        [
            "mirrorwave eval --objects",
            *(f"--set {name}" for name in report["sets"]),
            *(f"--profile {name}" for name in report["mean_loss"]),
        ]
    )
    rows = [
        ProfileLoss(profile=name, params=profile_setting(name).params, loss=round(loss, 4))
        for name, loss in report["mean_loss"].items()
    ]
    write_whole(COMMITTED, json_lines(ProfileLosses(command=command, rows=rows)))
    for row in rows:
        print(f"{row.profile:12} {row.loss:.3f}")


if __name__ == "__main__":
    main()
