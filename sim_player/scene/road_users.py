"""Road users as boxes of scattering centres: along the faces, stronger at corners and wheels, random in phase.

The mean over all aspects is the class's RCS. Not modelled: curved bodies, cavities, multiple scattering, roofs, legs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from msgs.values.units import ratio_from_db
from sim_player.scene.description import OBJECT_KINDS, ObjectKind

#: Mean spacing of the centres along a face.
CENTRE_SPACING_M = 0.28
#: Heights of the centres above ground: sills, bumpers, lamps.
CENTRE_HEIGHT_M = (0.3, 1.0)
#: Share of a face centre's RCS that has no lobe.
LOBE_FLOOR = 0.1
#: Peak RCS relative to a face centre: corners fold two faces together, wheels are cavities of metal.
CORNER_GAIN, WHEEL_GAIN = 1.0, 2.0
WHEELED = frozenset({"car", "van", "truck", "bus"})


@dataclass(frozen=True)
class ScatteringCentres:
    """Centres of one object in its own frame (origin on the ground in the middle), K of them."""

    #: [K, 3] in metres.
    position_m: np.ndarray
    #: Outward normals of the one or two faces each belongs to, [K, 2, 3].
    normals: np.ndarray
    #: RCS seen along the normal [m^2], and the phase in radians.
    peak_rcs_m2: np.ndarray
    phase_rad: np.ndarray
    #: Exponent of the lobe; 0 for centres without one.
    lobe_exponent: np.ndarray
    #: Share of the peak in all directions in front.
    lobe_floor: float = LOBE_FLOOR


def scattering_centres(object_class: str, seed: int, index: int) -> ScatteringCentres:
    """Return the centres of an object, fixed by (seed, index of the object in its scene) over all scans."""
    kind = OBJECT_KINDS[object_class]
    rng = np.random.default_rng([seed, 1, index])
    position, normals, gain, exponent = _layout(kind, object_class in WHEELED, rng)
    height = rng.uniform(*CENTRE_HEIGHT_M, len(position))
    centres = ScatteringCentres(
        position_m=np.column_stack([position, height]),
        normals=np.concatenate([normals, np.zeros((len(normals), 2, 1))], axis=2),
        peak_rcs_m2=gain * rng.exponential(1.0, len(position)),
        phase_rad=rng.uniform(0.0, 2.0 * np.pi, len(position)),
        lobe_exponent=exponent,
    )
    # averaged over all aspects and over speckle: the incoherent sum of the centres
    aspect = np.linspace(0.0, 2.0 * np.pi, 720, endpoint=False)
    direction = np.column_stack([np.cos(aspect), np.sin(aspect)])[:, None, :]
    shown_m2 = seen_rcs_m2(centres.peak_rcs_m2, centres.normals, centres.lobe_exponent, direction)
    scale = ratio_from_db(kind.mean_rcs_dbsm) / float(shown_m2.sum(axis=1).mean())
    return replace(centres, peak_rcs_m2=centres.peak_rcs_m2 * scale)


def seen_rcs_m2(
    peak_rcs_m2: np.ndarray,
    normals: np.ndarray,
    lobe_exponent: np.ndarray,
    direction: np.ndarray,
    lobe_floor: np.ndarray | float = LOBE_FLOOR,
) -> np.ndarray:
    """Return the RCS towards unit vectors [..., K, 3] (or [..., K, 2], level) from the centres; 0 if turned away."""
    axes = direction.shape[-1]
    first = np.einsum("...ki,ki->...k", direction, normals[:, 0, :axes])
    second = np.einsum("...ki,ki->...k", direction, normals[:, 1, :axes])
    cosine = np.maximum(first, second)
    lobe = lobe_floor + (1.0 - lobe_floor) * np.maximum(cosine, 0.0) ** lobe_exponent
    return np.where(cosine > 0.0, peak_rcs_m2 * lobe, 0.0)


def _layout(
    kind: ObjectKind, wheeled: bool, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the plan positions [K, 2], normals [K, 2, 2], relative RCS [K] and lobe exponents [K] of a class."""
    half = 0.5 * np.array([kind.length_m, kind.width_m])
    outward = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    position, normals, gain, exponent = [], [], [], []
    for normal in outward:
        along = np.array([-normal[1], normal[0]])
        reach = abs(along @ half)
        count = max(round(float(2.0 * reach / CENTRE_SPACING_M)) - 1, 1)
        # jittered: even spacing would make a grating
        offset = np.linspace(-reach, reach, count + 2)[1:-1] + rng.uniform(-0.25, 0.25, count) * CENTRE_SPACING_M
        position.append(normal * half + np.clip(offset, -reach, reach)[:, None] * along)
        normals.append(np.tile(normal, (count, 2, 1)))
        gain.append(np.ones(count))
        exponent.append(np.full(count, kind.lobe_exponent))
    for first, second in zip(outward, np.roll(outward, -1, axis=0), strict=True):
        position.append(((first + second) * half)[None])
        normals.append(np.stack([first, second])[None])
        gain.append(np.array([CORNER_GAIN]))
        exponent.append(np.zeros(1))
    if wheeled:
        axles = np.array([[0.62, 1.0], [-0.62, 1.0], [-0.62, -1.0], [0.62, -1.0]]) * half
        position.append(axles)
        normals.append(np.sign(axles)[:, None, :] * np.array([[0.0, 1.0], [0.0, 1.0]]))
        gain.append(np.full(4, WHEEL_GAIN))
        exponent.append(np.zeros(4))
    return np.concatenate(position), np.concatenate(normals), np.concatenate(gain), np.concatenate(exponent)
