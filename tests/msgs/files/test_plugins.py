"""Entry points of other packages: which can be used, and one line for each that cannot."""

from __future__ import annotations

from pathlib import Path

import pytest

from msgs.files.plugins import NODES, Plugin, import_named, plugins
from tests.plugins import write_package


def test_what_packages_bring_is_listed_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(
        write_package(tmp_path, "acme", NODES, {"b_radar": "acme_b", "a_radar": "acme.parts.a"})
    )
    brought = plugins(NODES)
    assert list(brought.usable.values()) == [
        Plugin("a_radar", "acme.parts.a", "acme 1.2"),
        Plugin("b_radar", "acme_b", "acme 1.2"),
    ]
    assert brought.refused == ()
    assert brought.plugin("b_radar") is brought.usable["b_radar"]
    assert brought.plugin("c_radar") is None
    assert plugins("mirrorwave.nothing").usable == {}


@pytest.mark.parametrize(
    ("points", "line"),
    [
        (
            {"my-radar": "m"},
            "my-radar of acme 1.2: a name must be of a-z, 0-9 and _, at most 64 of them, got 'my-radar'",
        ),
        ({"radar": "m:create"}, "radar of acme 1.2: must name a module, got 'm:create'"),
        ({"radar": "../evil"}, "radar of acme 1.2: must name a module, got '../evil'"),
    ],
)
def test_entries_that_name_nothing_are_refused(
    points: dict[str, str], line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(write_package(tmp_path, "acme", NODES, points))
    brought = plugins(NODES)
    assert (brought.usable, [str(refusal) for refusal in brought.refused]) == ({}, [line])
    with pytest.raises(ValueError, match=r"of acme 1\.2: "):
        brought.plugin(next(iter(points)))


def test_two_packages_of_one_name_are_refused_both(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Which would be used would depend on the order of installation; another package's parts are there."""
    for package in ("acme", "zeta"):
        monkeypatch.syspath_prepend(write_package(tmp_path / package, package, NODES, {"radar": f"{package}_radar"}))
    monkeypatch.syspath_prepend(write_package(tmp_path / "fine", "fine", NODES, {"sonar": "fine_sonar"}))
    brought = plugins(NODES)
    assert list(brought.usable) == ["sonar"]
    (refusal,) = brought.refused
    assert {refusal.plugin.package, refusal.reason.partition(" has ")[0]} == {"acme 1.2", "zeta 1.2"}
    assert refusal.reason.endswith(" has the same name; uninstall one")


@pytest.mark.parametrize(
    ("source", "line"),
    [
        ("import numpi.linalg", "broken needs numpi, which is not installed"),
        ("x = 1\ny = z", r"broken cannot be imported: NameError: name 'z' is not defined \(\S*broken.py:2\)"),
        ("def f(:", r"broken cannot be imported: SyntaxError: .* \(broken.py, line 1\)"),
        ("raise SystemExit(3)", r"broken cannot be imported: SystemExit: 3 \(\S*broken.py:1\)"),
        ("from math import cosh2", r"broken cannot be imported: ImportError: cannot import name 'cosh2' .*"),
        ("raise ValueError('two\\nlines')", r"broken cannot be imported: ValueError: two lines \(\S*broken.py:1\)"),
        ("\0", "broken cannot be imported: .*"),
    ],
)
def test_whatever_stops_a_module_is_one_line(
    source: str, line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "broken.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ValueError, match=f"^{line}$"):
        import_named("broken")
    with pytest.raises(ValueError, match=f"^radar of acme 1.2: {line}$"):
        Plugin("radar", "broken", "acme 1.2").load()


def test_a_module_that_lacks_a_part_says_which(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "half.py").write_text("ABOUT = 'half'")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ValueError, match=r"^radar of acme 1\.2: half must define absent, apply$"):
        Plugin("radar", "half", "acme 1.2").load("ABOUT", "absent", "apply")
    with pytest.raises(ValueError, match=r"^no module named 'no_such_module_at_all'$"):
        import_named("no_such_module_at_all")
