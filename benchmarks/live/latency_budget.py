"""What `launch --latency-budget-ms` picks on less than this machine, and what the profile that it picked then holds.

The graph of `launch/corner.yaml`, the simulated radar included, has all cores, one core, or a quota of processor time
in periods of 100 ms (needs root and the kernel's control groups). In each case a budget picks a profile, which then
runs for so many scans. In time is a view within 0.3 s. The scene's seed is that of the launch file.
Usage: python -m benchmarks.live.latency_budget [--budget-ms 300] [--scans 66] [--case all|one-core|CORES ...]
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import tempfile
from typing import Any

from benchmarks.live.live_graph import quantiles
from benchmarks.live.overload import Quota
from mirrorwave.studies.tradeoff.latency_budget import pick, run_live
from nodes.inputs.view_latency import DEADLINE_S

ALL, ONE_CORE = "all", "one-core"


def limited(case: str, budget_ms: float, scans: int) -> dict[str, Any]:
    """Limit this process and its children, let the budget pick, and run what it picked."""
    if case == ONE_CORE:
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    quota = None if case in (ALL, ONE_CORE) else Quota([os.getpid()], float(case))
    os.environ["XDG_CACHE_HOME"] = tempfile.mkdtemp(prefix="mirrorwave-")
    try:
        tried = pick(budget_ms)
    except ValueError as error:
        return {"picked": f"none ({error})"}
    else:
        latencies_ms = run_live(tried[-1].profile, scans).latencies_ms
    finally:
        if quota is not None:
            quota.release()
    return {"picked": tried[-1].profile, "tried": tried, "latencies_ms": latencies_ms}


def row(case: str, scans: int, result: dict[str, Any]) -> str:
    if "tried" not in result:
        return f"| {case} | {result['picked']} | | | |"
    tried = ", ".join(
        f"{item.profile} {'-' if item.expected_ms is None else round(item.expected_ms)}" for item in result["tried"]
    )
    latencies_ms = result["latencies_ms"]
    in_time = sum(latency_ms <= 1e3 * DEADLINE_S for latency_ms in latencies_ms)
    figures = quantiles(latencies_ms)
    return (
        f"| {case} | {result['picked']} | {tried} | {in_time}, {len(latencies_ms) - in_time}, "
        f"{max(0, scans - len(latencies_ms))} | {figures['p50']}, {figures['p99']}, {figures['max']} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--budget-ms", type=float, default=300.0)
    parser.add_argument("--scans", type=int, default=66)
    parser.add_argument("--case", dest="cases", action="append")
    arguments = parser.parse_args()
    print("| processor time | picked | tried, expected ms | in time, late, none | p50, p99, longest [ms] |")
    print("|" + " --- |" * 5)
    for case in arguments.cases or [ALL, ONE_CORE, "0.5", "0.25"]:
        # a process of its own, so that its limit ends with it
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            result = pool.apply(limited, (case, arguments.budget_ms, arguments.scans))
        print(row(case, arguments.scans, result), flush=True)


if __name__ == "__main__":
    main()
