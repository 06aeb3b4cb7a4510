"""The wheel in a clean environment, outside the checkout: size, time to the first picture, every command, removal.

Each environment is new, with an empty home and no cache of packages; its commands run in an empty folder. A picture is
what `mirrorwave process --sample` draws; its time counts from before the environment was made, download included.
Processor time is that of all programs that were started up to then. Only the standard library is needed, so that any
interpreter can run it.
Usage: python -m benchmarks.installation.clean_environment [--python PYTHON] [--with pip|pipx|uv] [--wheel FILE]
[--json]
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import platform
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

CHECKOUT = Path(__file__).resolve().parents[2]
#: The largest parts that are named.
PARTS = 12
#: Commands that end by themselves, and what they leave behind.
COMMANDS: dict[str, tuple[list[str], str]] = {
    "demo": (["demo", "--headless", "--duration", "5"], "out/demo/bev.png"),
    "process": (["process", "--sample", "--out", "out/sample"], "out/sample/objects.jsonl"),
    "launch": (["launch", "launch/corner.yaml", "--headless", "--duration", "5", "--record", "seen.mcap"], "seen.mcap"),
    "sim": (["sim", "run", "launch/scenes/corner.yaml", "--effects", "basic", "--out", "corner.mcap"], "corner.mcap"),
}
#: Commands that serve a page until Ctrl-C.
PAGES: dict[str, list[str]] = {"process --view": ["process", "--sample", "--view"], "view": ["view", "--sample"]}


class Installation:
    """The wheel, installed by one of three tools into a folder of its own."""

    def __init__(self, tool: str, python: str, wheel: Path, folder: Path) -> None:
        self.folder = folder
        (folder / "home").mkdir()
        (folder / "work").mkdir()
        inherited = {name: os.environ[name] for name in os.environ if name.startswith(("PIP_", "UV_", "SSL_", "LANG"))}
        self.variables = inherited | {
            "PATH": f"{folder / 'bin'}:{os.environ['PATH']}",
            "HOME": str(folder / "home"),
            "MIRRORWAVE_RUN_DIR": str(folder / "r"),
            "PIP_NO_CACHE_DIR": "1",
            "PIPX_HOME": str(folder / "pipx"),
            "PIPX_BIN_DIR": str(folder / "bin"),
            "UV_TOOL_DIR": str(folder / "uv"),
            "UV_TOOL_BIN_DIR": str(folder / "bin"),
            "UV_NO_CACHE": "1",
        }
        pip = str(folder / "bin" / "pip")
        make = {"pip": [[python, "-m", "venv", str(folder)]]}.get(tool, [])
        install = {
            "pip": [pip, "install", "--quiet", str(wheel)],
            "pipx": ["pipx", "install", "--quiet", "--python", python, str(wheel)],
            "uv": ["uv", "tool", "install", "--quiet", "--python", python, str(wheel)],
        }
        remove = {
            "pip": [pip, "uninstall", "--quiet", "--yes"],
            "pipx": ["pipx", "uninstall"],
            "uv": ["uv", "tool", "uninstall"],
        }
        for command in [*make, install[tool]]:
            self._call(command)
        self._remove = [*remove[tool], "mirrorwave"]
        self.program = folder / "bin" / "mirrorwave"

    def packages(self) -> Path:
        """Return the folder of its packages."""
        return next(path for path in self.folder.rglob("site-packages") if (path / "mirrorwave").is_dir())

    def run(self, *words: str) -> subprocess.CompletedProcess[str]:
        """Run the command in the empty folder."""
        return subprocess.run(
            [str(self.program), *words], cwd=self.folder / "work", env=self.variables, capture_output=True, text=True,
            check=False,
        )  # fmt: skip

    @contextlib.contextmanager
    def page(self, *words: str) -> Iterator[str]:
        """Run a command that serves a page; gives its address and ends it by Ctrl-C, which must be a good end."""
        command = [str(self.program), *words, "--no-browser", "--port", "0"]
        environment = self.variables | {"PYTHONUNBUFFERED": "1"}
        with subprocess.Popen(
            command, cwd=self.folder / "work", env=environment, stdout=subprocess.PIPE, text=True
        ) as process:
            assert process.stdout is not None
            try:
                yield next(line for line in process.stdout if "open http" in line).split("open ")[1].split()[0]
            finally:
                process.send_signal(signal.SIGINT)
        if process.returncode:
            raise RuntimeError(f"{' '.join(words)} ended with {process.returncode}")

    def remove(self) -> None:
        """Uninstall it."""
        self._call(self._remove)

    def _call(self, command: list[str]) -> None:
        done = subprocess.run(
            command, env=self.variables, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False
        )
        if done.returncode:
            raise RuntimeError(f"{' '.join(command)}: {done.stderr[-2000:]}")


def measure(tool: str, python: str, wheel: Path, folder: Path) -> dict[str, Any]:
    """Install, look, run everything and remove; returns the figures."""
    start_s, start_cpu_s = time.monotonic(), children_cpu_s()
    installed = Installation(tool, python, wheel, folder)
    install_s, install_cpu_s = time.monotonic() - start_s, children_cpu_s() - start_cpu_s
    first = installed.run("process", "--sample", "--out", "out/first")
    picture_s, picture_cpu_s = time.monotonic() - start_s, children_cpu_s() - start_cpu_s
    if first.returncode or not (folder / "work" / "out" / "first" / "bev.png").exists():
        raise RuntimeError(f"process --sample: {first.stderr}")
    start_s = time.monotonic()
    installed.run("process", "--sample", "--out", "out/second")
    second_s = time.monotonic() - start_s
    sizes = sizes_of(installed.packages())
    commands = {name: outcome(installed, *COMMANDS[name]) for name in COMMANDS} | {
        name: served(installed, words) for name, words in PAGES.items()
    }
    installed.remove()
    return {
        "tool": tool,
        "python": platform_of(python),
        "install_s": round(install_s, 1),
        "install_cpu_s": round(install_cpu_s, 1),
        "first_picture_s": round(picture_s, 1),
        "first_picture_cpu_s": round(picture_cpu_s, 1),
        "next_picture_s": round(second_s, 1),
        "megabytes": round(1e-6 * sizes.total(), 1),
        "parts_megabytes": {name: round(1e-6 * size, 1) for name, size in sizes.most_common(PARTS)},
        "commands": commands,
        "command_left": installed.program.exists(),
    }


def children_cpu_s() -> float:
    """Return the processor time of all programs that have ended."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def outcome(installed: Installation, words: list[str], made: str) -> str:
    """Return "ok", or why not."""
    done = installed.run(*words)
    if done.returncode:
        return f"exit code {done.returncode}: {done.stderr.strip().splitlines()[-1:]}"
    return "ok" if (installed.folder / "work" / made).exists() else f"no {made}"


def served(installed: Installation, words: list[str]) -> str:
    """Return "ok" where the page came."""
    with installed.page(*words) as address, urllib.request.urlopen(address, timeout=60) as answer:
        return "ok" if answer.status == 200 and b"<html" in answer.read().lower() else f"status {answer.status}"


def sizes_of(packages: Path) -> Counter[str]:
    """Return bytes by top-level entry; shared libraries beside a package are its own."""
    sizes: Counter[str] = Counter()
    for path in packages.rglob("*"):
        if path.is_file() and not path.is_symlink():
            sizes[path.relative_to(packages).parts[0].removesuffix(".libs")] += path.stat().st_size
    return sizes


def platform_of(python: str) -> str:
    """Return the version of an interpreter."""
    command = [python, "-c", "import platform; print(platform.python_version())"]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def build(folder: Path) -> Path:
    """Build the wheel of the checkout."""
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(folder), str(CHECKOUT)]
    subprocess.run(command, check=True)
    (made,) = folder.glob("*.whl")
    return made


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--python", default=sys.executable, help="interpreter of the environment")
    parser.add_argument("--with", dest="tool", choices=("pip", "pipx", "uv"), default="pip")
    parser.add_argument("--wheel", type=Path, help="built from the checkout where not given")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    if arguments.tool != "pip" and not shutil.which(arguments.tool):
        parser.error(f"{arguments.tool} is not installed: pip install {arguments.tool}")
    # in the background of a shell it is ignored, and the programs that are ended by it would ignore it too
    signal.signal(signal.SIGINT, signal.default_int_handler)
    # a short path: names of sockets are limited
    with tempfile.TemporaryDirectory(prefix="mw") as scratch, tempfile.TemporaryDirectory(prefix="mw") as folder:
        wheel = arguments.wheel.resolve() if arguments.wheel else build(Path(scratch))
        result = measure(arguments.tool, arguments.python, wheel, Path(folder))
        result = {
            "machine": f"{os.cpu_count()} cores, {platform.platform()}",
            "wheel_bytes": wheel.stat().st_size,
        } | result
    print(json.dumps(result, indent=None if arguments.json else 2))


if __name__ == "__main__":
    main()
