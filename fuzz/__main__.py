"""`python -m fuzz [TARGET...] [--seconds S] [--json FILE]`: all targets one after the other, each in its own process.

Without a target all of them share the time. A target goes on where its last run ended (`--work`); what is found lies in
`WORK/TARGET/findings`, one input for each place in the code, and ends the command with exit code 1.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from fuzz.targets import TARGETS

ROOT = Path(__file__).resolve().parents[1]
CORPUS = Path(__file__).parent / "corpus"
#: Limits of one input, and of a process as a whole.
TIMEOUT_S, RSS_MB = 10, 2048
SHARED_MEMORY = Path("/dev/shm")
#: A target whose processes end so often before their time is left alone.
MAX_ATTEMPTS = 20
_LAST = re.compile(r"#(?P<runs>\d+)\s+\w+\s+cov: (?P<edges>\d+) ft: (?P<features>\d+) corp: (?P<corpus>\d+)/")
_NEW = re.compile(r"#(?P<runs>\d+)\s+NEW\s+cov: (?P<edges>\d+)")
_RUNS = re.compile(r"#(?P<runs>\d+)\s")
COLUMNS = ("target", "runs", "runs_per_s", "cpu_s", "edges", "last_new_at", "corpus", "findings")


def main() -> int:
    """Run what the command line asks for; 1 where something was found."""
    options = _parser().parse_args()
    if options.child:
        from fuzz.engine import fuzz

        fuzz(options.targets[0], options.work)
        return 0
    names = options.targets or list(TARGETS)
    unknown = sorted(set(names) - set(TARGETS))
    if unknown:
        sys.stderr.write(f"unknown target {', '.join(unknown)}; known are {', '.join(TARGETS)}\n")
        return 2
    rows = []
    for name in names:
        rows.append(_fuzz(name, options.seconds / len(names), options.work / name))
        _say(_cells(rows[-1]), header=len(rows) == 1)
    if options.json is not None:
        options.json.write_text(json.dumps({"seconds": options.seconds, "targets": rows}, indent=1) + "\n")
    found = [each for row in rows for each in row["findings"]]
    for each in found:
        sys.stdout.write(f"{each}\n")
    return 1 if found else 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m fuzz", description=__doc__)
    parser.add_argument("targets", nargs="*", metavar="TARGET", help=f"of {', '.join(TARGETS)}; default: all")
    parser.add_argument("--seconds", type=float, default=600.0, help="time of all targets together (600)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the table here too")
    parser.add_argument("--work", type=Path, default=ROOT / "runs" / "fuzz", metavar="DIR", help="inputs and findings")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    return parser


def _fuzz(name: str, seconds: float, work: Path) -> dict[str, Any]:
    """Fuzz a target; a process that ends before its time (a hang, a crash of native code) is followed by another."""
    findings = work / "findings"
    for folder in (work / "inputs", findings, CORPUS / name):
        folder.mkdir(parents=True, exist_ok=True)
    started_s, cpu_s = time.monotonic(), _children_cpu_s()
    row: dict[str, Any] = {"target": name} | dict.fromkeys(("runs", "edges", "features", "last_new_at", "corpus"), 0)
    attempts = 0
    while (left_s := seconds - (time.monotonic() - started_s)) > 0.5 and (attempts := attempts + 1) <= MAX_ATTEMPTS:
        log = work / "log.txt"
        with log.open("wb") as out:
            arguments = [
                *(f"-max_total_time={round(left_s) or 1}", f"-timeout={TIMEOUT_S}", f"-rss_limit_mb={RSS_MB}"),
                *(f"-max_len={TARGETS[name].max_bytes}", f"-artifact_prefix={findings}/", "-print_final_stats=1"),
                *(str(work / "inputs"), str(CORPUS / name)),
            ]
            command = [sys.executable, "-m", "fuzz", name, "--child", "--work", str(work)]
            with tempfile.TemporaryDirectory(dir=SHARED_MEMORY if SHARED_MEMORY.is_dir() else None) as scratch:
                environment = {"OPENBLAS_NUM_THREADS": "1", "FUZZ_ARGUMENTS": json.dumps(arguments), "TMPDIR": scratch}
                process = subprocess.run(command, cwd=ROOT, stdout=out, stderr=out, env=os.environ | environment)
        _add_log(row, log.read_text(errors="replace"))
        if process.returncode == 0:
            break
        log.rename(work / f"log-{time.monotonic_ns()}.txt")
    took_s = max(time.monotonic() - started_s, 1e-9)
    found = sorted(str(path) for path in findings.iterdir() if path.suffix != ".txt")
    figures = {"runs_per_s": round(row["runs"] / took_s, 1), "cpu_s": round(_children_cpu_s() - cpu_s, 1)}
    return row | figures | {"findings": found}


def _add_log(row: dict[str, Any], log: str) -> None:
    """Take in what libFuzzer wrote."""
    lines = [found.groupdict() for found in _LAST.finditer(log)]
    if lines:
        row["last_new_at"] = row["runs"] + max((int(one["runs"]) for one in _NEW.finditer(log)), default=0)
        row["runs"] += max(int(one["runs"]) for one in _RUNS.finditer(log))
        for key in ("edges", "features", "corpus"):
            row[key] = max(row[key], int(lines[-1][key]))


def _children_cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _cells(row: dict[str, Any]) -> list[str]:
    return [str(len(row[name]) if name == "findings" else row[name]) for name in COLUMNS]


def _say(cells: list[str], header: bool) -> None:
    for line in ([list(COLUMNS)] if header else []) + [cells]:
        sys.stdout.write(" ".join(f"{cell:>14}" for cell in line) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
