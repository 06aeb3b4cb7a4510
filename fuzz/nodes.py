"""`python -m fuzz.nodes [NODE...] [--examples N] [--json FILE]`: every node against thousands of scripts of messages.

Each node has a process of its own, which runs its two tests of `tests/fuzz/test_nodes.py`; what they print lies in
`WORK`. Exit code 1 where a test fails.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import subprocess
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

ROOT = Path(__file__).resolve().parents[1]
TESTS = "tests/fuzz/test_nodes.py"
#: A test's name and what its examples are made of.
KINDS = {"test_no_message_and_no_time_breaks_a_node": "messages", "test_parameters_make_a_node_or_a_line": "parameters"}
COLUMNS = ("node", "kind", "examples", "cpu_s", "slowest_cpu_s", "start_mib", "end_mib", "failed")


def main() -> int:
    """Run what the command line asks for; 1 where a test failed."""
    sys.path.insert(0, str(ROOT))
    from tests.fuzz.cases import CASES

    parser = argparse.ArgumentParser(prog="python -m fuzz.nodes", description=__doc__)
    parser.add_argument("nodes", nargs="*", metavar="NODE", help=f"of {', '.join(CASES)}; default: all")
    parser.add_argument("--examples", type=int, default=2000, help="of each test (2000)")
    parser.add_argument("--seed", type=int, default=0, help="of Hypothesis (0)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the table here too")
    parser.add_argument("--work", type=Path, default=ROOT / "runs" / "fuzz" / "nodes", metavar="DIR", help="logs")
    options = parser.parse_args()
    unknown = sorted(set(options.nodes) - set(CASES))
    if unknown:
        sys.stderr.write(f"unknown node {', '.join(unknown)}; known are {', '.join(CASES)}\n")
        return 2
    options.work.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, Any]] = []
    for name in options.nodes or CASES:
        for row in _fuzzed(name, options):
            sys.stdout.write(" ".join(f"{row[key]!s:>24}" for key in COLUMNS) + "\n")
            sys.stdout.flush()
            rows.append(row)
    if options.json is not None:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps({"seed": options.seed, "nodes": rows}, indent=1) + "\n")
    return int(any(row["failed"] for row in rows))


def _fuzzed(name: str, options: argparse.Namespace) -> list[dict[str, Any]]:
    """Both tests of a node in a process of their own: a row each."""
    stem = options.work / re.sub(r"\W+", "_", name).strip("_")
    report = stem.with_suffix(".xml")
    report.unlink(missing_ok=True)
    command = [
        *(sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--hypothesis-show-statistics"),
        *(f"--hypothesis-seed={options.seed}", f"--junitxml={report}", "-o", "junit_family=xunit1"),
        # any number of examples may be asked for
        *("-o", "faulthandler_timeout=0"),
        *(f"{TESTS}::{test}[{name}]" for test in KINDS),
    ]
    environment = {"OPENBLAS_NUM_THREADS": "1", "MIRRORWAVE_FUZZ_EXAMPLES": str(options.examples)}
    before_s = _children_cpu_s()
    with stem.with_suffix(".txt").open("wb") as out:
        process = subprocess.run(command, cwd=ROOT, stdout=out, stderr=out, env=os.environ | environment)
    cases = list(ElementTree.parse(report).iter("testcase")) if report.exists() else []
    if len(cases) < len(KINDS):
        lost = dict.fromkeys(COLUMNS, "") | {"node": name, "failed": f"process ended, {process.returncode}"}
        return [lost | {"cpu_s": round(_children_cpu_s() - before_s, 1)}]
    return [_row(name, case) for case in cases]


def _row(name: str, case: ElementTree.Element) -> dict[str, Any]:
    figures = {one.get("name", ""): float(one.get("value", "0")) for one in case.iter("property")}
    row = {"node": name, "kind": KINDS[case.get("name", "").partition("[")[0]], **figures}
    failed = case.find("failure") is not None or case.find("error") is not None
    return dict.fromkeys(COLUMNS, "") | row | {"failed": int(failed)}


def _children_cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    sys.exit(main())
