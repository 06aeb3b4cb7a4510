"""Wheels of all dependencies: which set resolves for which Python on which processor, nothing built from source.

The resolver is uv's, which evaluates markers for the machine that is asked about. Nothing is downloaded but metadata.
Usage: python -m benchmarks.installation.resolver [--uv PROGRAM] [--json]
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import tomllib
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[2] / "pyproject.toml"
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
MACHINES = ("x86_64", "aarch64")
#: By glibc, the oldest first: Debian 10 and Ubuntu 18.10; Debian 12 and Ubuntu 22.04.
GLIBCS = ("2_28", "2_35")
#: The tests' own set holds others.
LEFT_OUT = {"dev"}


def resolve(uv: str, python: str, platform: str, extra: str) -> tuple[int, str]:
    """Return the number of distributions, or 0 with the reason where they do not resolve."""
    command = [uv, "pip", "compile", "--quiet", "--no-header", "--no-annotate", "--only-binary", ":all:"]
    command += ["--python-version", python, "--python-platform", platform]
    command += [*(["--extra", extra] if extra else []), str(PROJECT)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        return 0, reason_of(done.stderr)
    return len(re.findall(r"^[A-Za-z0-9].*==", done.stdout, re.MULTILINE)), ""


def reason_of(text: str) -> str:
    """Return why uv finds no wheel, without its conclusions."""
    words = " ".join(text.split())
    return match[1] if (match := re.search(r"[Bb]ecause (\S+ has no .+?)(?: and |,|$)", words)) else words


def cell(uv: str, python: str, machine: str, extra: str) -> dict[str, object]:
    """Return what resolves with the oldest glibc that has wheels."""
    row: dict[str, object] = {"extra": extra, "machine": machine, "python": python}
    count, reason = 0, ""
    for glibc in GLIBCS:
        count, reason = resolve(uv, python, f"{machine}-manylinux_{glibc}", extra)
        if count:
            return row | {"distributions": count, "glibc": glibc.replace("_", "."), "reason": ""}
    return row | {"distributions": 0, "glibc": "", "reason": reason}


def matrix(uv: str) -> list[dict[str, object]]:
    """Return one row for each Python, processor and extra; the extra "" is the installation itself."""
    extras = tomllib.loads(PROJECT.read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    asked = ["", *(name for name in extras if name not in LEFT_OUT)]
    return [cell(uv, python, machine, extra) for extra in asked for machine in MACHINES for python in PYTHONS]


def table(rows: list[dict[str, object]]) -> str:
    """Return the matrix as Markdown: distributions of a set with the glibc they need, or a dash; then the reasons."""
    heads = [f"{machine} {python}" for machine in MACHINES for python in PYTHONS]
    lines = [f"| | {' | '.join(heads)} |", f"| --- |{' --- |' * len(heads)}"]
    for extra in dict.fromkeys(str(row["extra"]) for row in rows):
        cells = [
            f"{row['distributions']}, {row['glibc']}" if row["glibc"] else "-" for row in rows if row["extra"] == extra
        ]
        lines.append(f"| {f'`{extra}`' if extra else 'the installation'} | {' | '.join(cells)} |")
    missing: dict[str, list[str]] = {}
    for row in rows:
        if row["reason"]:
            missing.setdefault(f"{row['extra']}: {row['reason']}", []).append(f"{row['machine']} {row['python']}")
    return "\n".join([*lines, "", *(f"{reason} ({', '.join(where)})" for reason, where in missing.items())])


def main() -> None:
    """Ask and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--uv", default="uv", help="program (pip install uv)")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    rows = matrix(arguments.uv)
    print(json.dumps(rows) if arguments.json else table(rows))


if __name__ == "__main__":
    main()
