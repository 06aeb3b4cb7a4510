"""Sionna RT as it is called here: one image worked out by hand, and what is said where it cannot run."""

from __future__ import annotations

import importlib
import math
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from lab.foreign.export import SurfaceKind, exported_surfaces
from lab.foreign.sionna_tracer import ForeignTracerMissingError, load_sionna, trace_to_points
from models.physics.fresnel import slab_reflection
from models.physics.materials import permittivity
from sim_player.scene.description import Scene, Surface
from sim_player.scene.world import prepare
from tests.lab.foreign.requirements import require_sionna

WALL = Surface(role="relay", material="brick", polyline_m=((10.0, -20.0), (10.0, 20.0)), thickness_mm=120.0)
ANTENNA, POINTS = np.array([0.0, 0.0, 1.0]), np.array([[2.0, -6.0, 0.5], [2.0, 40.0, 1.0]])


def test_a_missing_package_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "drjit", None)
    with pytest.raises(
        ForeignTracerMissingError, match=r"^the foreign tracer needs .*pip install 'mirrorwave\[foreign\]'$"
    ):
        load_sionna()


@pytest.mark.parametrize(
    ("has_llvm", "version", "got"), [(True, (15, 0, 6), "15.0.6"), (False, None, "none")], ids=["old", "none"]
)
def test_an_llvm_that_would_end_the_process_is_one_line(
    monkeypatch: pytest.MonkeyPatch, has_llvm: bool, version: tuple[int, ...] | None, got: str
) -> None:
    fake = ModuleType("drjit")
    fake.JitBackend = SimpleNamespace(LLVM=object())  # type: ignore[attr-defined]
    fake.has_backend = lambda _: has_llvm  # type: ignore[attr-defined]
    fake.detail = SimpleNamespace(llvm_version=lambda: version)  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "drjit", fake)
    with pytest.raises(ForeignTracerMissingError, match=f"LLVM 17 or newer, got {got}: install libllvm19"):
        load_sionna()


def test_our_modules_do_not_import_it() -> None:
    for name in ("export", "one_way", "sionna_tracer"):
        source = importlib.import_module(f"lab.foreign.{name}").__dict__
        assert not {"sionna", "mitsuba", "drjit"} & set(source)


def test_one_wall_against_its_image() -> None:
    """Wall x = 10, point (2, -6, 0.5): image (18, -6, 0.5); the second point's image lies beyond the wall's end.

    Single precision: lengths to 1e-4 m, directions to 1e-4 rad. Amplitude 0.05 dB: the ray climbs 1.5 deg, so vertical
    polarisation is not TE alone.
    """
    require_sionna()
    surfaces = exported_surfaces(prepare(Scene(name="one wall", surfaces=(WALL,))))
    paths = trace_to_points(surfaces, ANTENNA, POINTS, 10e9, samples=20_000)
    mirrored = paths.take(paths.surface[:, 0] >= 0)
    assert sorted(paths.target.tolist()) == [0, 0, 1]
    assert mirrored.target.tolist() == [0]
    ray = np.array([18.0, -6.0, -0.5])
    length_m = np.linalg.norm(ray)
    np.testing.assert_allclose(mirrored.length_m, length_m, atol=1e-4)
    np.testing.assert_allclose(mirrored.depart[0], ray / length_m, atol=1e-4)
    np.testing.assert_allclose(mirrored.arrive[0], ray * [-1.0, 1.0, 1.0] / length_m, atol=1e-4)
    expected = slab_reflection(
        np.array(permittivity("brick", 10e9)), np.array(18.0 / length_m), np.array(0.12), 299_792_458.0 / 10e9
    )
    assert abs(20.0 * math.log10(abs(complex(mirrored.reflection[0])) / abs(complex(expected)))) < 0.05
    assert abs(np.angle(mirrored.reflection[0] / expected)) < 0.02
    np.testing.assert_allclose(mirrored.vertex_m[0, 0], [10.0, -10.0 / 3.0, 1.0 - 0.5 / 1.8], atol=1e-3)
    assert surfaces[mirrored.surface[0, 0]].kind == SurfaceKind.WALL


def test_no_points_no_paths() -> None:
    require_sionna()
    surfaces = exported_surfaces(prepare(Scene(name="one wall", surfaces=(WALL,))))
    assert len(trace_to_points(surfaces, ANTENNA, np.zeros((0, 3)), 10e9)) == 0
