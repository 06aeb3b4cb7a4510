"""The locked requirements: every one that pyproject.toml declares, at a version that it allows, with checksums."""

from __future__ import annotations

import re
import tomllib

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from msgs.files.shipped import CHECKOUT

PROJECT = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())["project"]
EXTRAS = PROJECT["optional-dependencies"]
#: Each kind of processor has a build of its own.
UNLOCKED = {"torch"}
_LINE = re.compile(r"^(?P<name>[a-z0-9._-]+)==(?P<version>[^ ]+)(?P<rest>.*)$", re.DOTALL)


def locked(name: str) -> dict[str, dict[str, str]]:
    """Return the versions of each package in a lock and what follows each, its marker and checksums."""
    text = (CHECKOUT / name).read_text().replace("\\\n", " ")
    packages: dict[str, dict[str, str]] = {}
    for line in text.splitlines():
        parts = _LINE.match(line)
        assert parts is not None, line
        packages.setdefault(canonicalize_name(parts["name"]), {})[parts["version"]] = parts["rest"]
    return packages


def declared(extra: str | None) -> list[Requirement]:
    """Return the requirements of the project, or of an extra and those that it takes in."""
    words = PROJECT["dependencies"] if extra is None else EXTRAS[extra]
    requirements = [Requirement(word) for word in words]
    own = [inner for item in requirements if item.name == "mirrorwave" for inner in item.extras]
    return [item for item in requirements if item.name != "mirrorwave"] + [
        item for inner in sorted(own) for item in declared(inner)
    ]


@pytest.mark.parametrize(
    ("name", "requirements"),
    [
        ("requirements.lock", declared(None)),
        ("requirements-dev.lock", declared(None) + declared("dev")),
    ],
    ids=["run", "dev"],
)
def test_a_lock_has_what_is_declared_with_checksums_and_no_address(name: str, requirements: list[Requirement]) -> None:
    packages = locked(name)
    assert not UNLOCKED & packages.keys()
    for item in requirements:
        versions = packages.get(canonicalize_name(item.name), {})
        assert versions or item.name in UNLOCKED, f"{name} lacks {item.name}: make lock"
        assert all(item.specifier.contains(version) for version in versions), f"{name}: {item}: make lock"
    for package, versions in packages.items():
        assert all("--hash=sha256:" in rest for rest in versions.values()), package
    assert "//" not in (CHECKOUT / name).read_text()


def test_both_locks_name_the_same_versions() -> None:
    run, dev = locked("requirements.lock"), locked("requirements-dev.lock")
    assert {package: set(dev[package]) for package in run} == {package: set(run[package]) for package in run}


def test_the_container_takes_files_by_checksum_and_its_base_by_digest() -> None:
    text = (CHECKOUT / "Containerfile").read_text()
    assert re.search(r"^ARG BASE=\S+@sha256:[0-9a-f]{64}$", text, re.MULTILINE)
    installs = re.findall(r"pip install [^\n]*", text)
    assert [("--require-hashes" in line, "--no-deps" in line) for line in installs] == [(True, False), (False, True)]
