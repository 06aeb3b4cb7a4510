"""Diffraction by upright edges: the uniform theory (Kouyoumjian and Pathak, 1974) for walls' ends and corners.

Angles are measured in the plane from the wedge's first face, 0..n pi through the air; n = 2 is a thin wall's end,
n = 1.5 a house corner. Vertical polarisation: the field lies along the edge (soft), so faces enter with their TE
reflection. The uniform field has no jump at the borders of shadow and reflection, where the ray field has one.
"""

from __future__ import annotations

import cmath
import math

import numpy as np

from models.compiled import compiled


def _series(order: int) -> tuple[float, np.ndarray]:
    """Return scale and coefficients of the rational series of w(z) (Weideman, 1994), highest power first."""
    steps = 2 * order
    scale = math.sqrt(order / math.sqrt(2.0))
    node = scale * np.tan(0.5 * np.pi * np.arange(-steps + 1, steps) / steps)
    values = np.concatenate([[0.0], np.exp(-np.square(node)) * (scale**2 + np.square(node))])
    terms = np.fft.fft(np.fft.fftshift(values)).real / (2 * steps)
    return scale, np.ascontiguousarray(terms[order:0:-1])


#: 32 terms hold w to 1e-13 of itself on the ray that edges need.
_SCALE, _TERMS = _series(32)


@compiled(error_model="numpy")
def scaled_erfc(root):  # type: ignore[no-untyped-def]
    """Return e^{jx} erfc(e^{j pi/4} sqrt x) for one sqrt(x) >= 0: `wofz` on the ray of the Fresnel integrals."""
    # z = e^{3j pi/4} root
    turned = complex(-math.sqrt(0.5) * root, math.sqrt(0.5) * root) * 1j
    below = _SCALE - turned
    ratio, total = (_SCALE + turned) / below, 0.0j
    for term in _TERMS:
        total = total * ratio + term
    return 2.0 * total / (below * below) + (1.0 / math.sqrt(math.pi)) / below


@compiled(error_model="numpy")
def passed_share_at(v):  # type: ignore[no-untyped-def]
    """Return the share of a wave that passes an edge at Fresnel's argument v, 1/2 + (1 + j)/2 (C(v) - j S(v))."""
    root = math.sqrt(0.5 * math.pi) * abs(v)
    dark = 0.5 * cmath.exp(-1j * root * root) * scaled_erfc(root)
    return dark if v < 0.0 else 1.0 - dark


#: Fresnel's arguments between which an edge's own wave is faded out of the ray that passes beside it. Beyond, its path
#: is longer by more than a range bin: an echo of its own, not a part of this one.
FADES_FROM, FADES_TO = 3.0, 6.0


@compiled(error_model="numpy")
def passed_edge_at(clearance_m, before_m, behind_m, wavelength_m):  # type: ignore[no-untyped-def]
    """Return the share of a ray's field that goes on where it clears an edge, metres before and behind it.

    v = clearance sqrt(2 (1 / before + 1 / behind) / lambda) (ITU-R P.526-15, Eq. 26); exactly 1 or 0 beyond `FADES_TO`.
    """
    return faded_share_at(clearance_m * math.sqrt(2.0 * (1.0 / before_m + 1.0 / behind_m) / wavelength_m))


@compiled(error_model="numpy")
def faded_share_at(v):  # type: ignore[no-untyped-def]
    """Return `passed_share_at` of v with the edge's own wave faded out: exactly 1 or 0 beyond `FADES_TO`."""
    lit = 1.0 if v >= 0.0 else 0.0
    if abs(v) >= FADES_TO:
        return lit + 0.0j
    bent = passed_share_at(-abs(v))
    if abs(v) > FADES_FROM:
        bent *= 0.5 + 0.5 * math.cos(math.pi * (abs(v) - FADES_FROM) / (FADES_TO - FADES_FROM))
    return lit - bent if v >= 0.0 else bent


@compiled(error_model="numpy")
def reflected_term_at(n, to_face_rad, distance_m, wavelength_m):  # type: ignore[no-untyped-def]
    """Return the term of one face in a wedge's echo of a wave, per unit of the face's reflection [sqrt(m)].

    Source and target lie at `to_face_rad`; where pi - 2 to_face_rad >= 0 the face's image is there and half of it is
    taken away. A negative distance is that beyond an arc's focus: the conjugate transition function.
    """
    k = 2.0 * np.pi / wavelength_m
    term = _term_at(n, 2.0 * to_face_rad, -1.0, k * abs(distance_m), False)
    if distance_m < 0.0:
        term = term.conjugate()
    return -cmath.exp(-0.25j * np.pi) / (2.0 * n * math.sqrt(2.0 * np.pi * k)) * term


@compiled(error_model="numpy")
def wedge_terms_at(n, to_source_rad, to_target_rad, distance_m, wavelength_m, sin_skew):  # type: ignore[no-untyped-def]
    """Return parts of the diffraction coefficient [sqrt(m)] of a wedge with exterior angle n pi, for one wave.

    Terms at the borders of the incident field (opaque wedge) and of what the first and the last face reflect, per unit
    of it. `distance_m` is s s' sin^2(skew) / (s + s'), skew between ray and edge. Times sqrt((s + s') / (s s')) it is
    the field via the edge against 1/L.
    """
    k = 2.0 * np.pi / wavelength_m
    minus, plus = to_target_rad - to_source_rad, to_target_rad + to_source_rad
    scale = -cmath.exp(-0.25j * np.pi) / (2.0 * n * math.sqrt(2.0 * np.pi * k) * sin_skew)
    incident = _term_at(n, minus, 1.0, k * distance_m, True) + _term_at(n, minus, -1.0, k * distance_m, True)
    first, last = _term_at(n, plus, -1.0, k * distance_m, False), _term_at(n, plus, 1.0, k * distance_m, False)
    return scale * incident, scale * first, scale * last


@compiled(error_model="numpy")
def _term_at(n, beta, sign, kl, dark):  # type: ignore[no-untyped-def]
    """Return cot((pi +- beta) / 2n) F(k L a(beta)), finite where the cotangent is not; on the border: `dark` or lit.

    F(x) = 2j sqrt(x) e^{jx} integral from sqrt(x) of e^{-jt^2} dt is 0 at 0 and 1 far away.
    """
    turns = np.rint((beta + sign * np.pi) / (2.0 * np.pi * n))
    half = math.cos(0.5 * (2.0 * n * np.pi * turns - beta))
    angle = (np.pi + sign * beta) / (2.0 * n)
    sine, cosine = math.sin(angle), math.cos(angle)
    # next to a border cot ~ 1/x and F ~ sqrt(x): their product tends to a limit with the border's sign
    if abs(sine) < 1e-7:
        side = -1.0 if sine < 0.0 or dark else 1.0
        return math.sqrt(2.0 * np.pi * kl) * n * side * cmath.exp(0.25j * np.pi) * cosine
    root = math.sqrt(kl * 2.0) * abs(half)
    transition = 1j * math.sqrt(np.pi) * cmath.exp(-0.25j * np.pi) * root * scaled_erfc(root)
    return cosine / sine * transition
