"""Every effect the simulator knows, by name and bit, in the order in which they act."""

from __future__ import annotations

#: Paths: what returns an echo, and by which way.
PATH_EFFECTS = (
    "los_objects",
    "los_surfaces",
    "specular_relay",
    "diffuse_scattering",
    "curved_wall",
    "second_relay",
    "non_cofocal",
    "wall_transmission",
    "edge_diffraction",
    "ground_bounce",
    "object_interreflection",
)
#: Weights: what changes the paths that are there.
WEIGHT_EFFECTS = ("rough_wall_loss", "slab_resonance", "vegetation", "atmosphere")
#: Signal: motion, antenna, waveform, receiver.
SIGNAL_EFFECTS = (
    "motion",
    "element_pattern",
    "quantised_phases",
    "mutual_coupling",
    "squint",
    "chirp_overlap",
    "thermal_noise",
    "flicker",
    "leakage",
    "adc",
    "iq_imbalance",
    "spurs",
)
ALL_EFFECTS = frozenset(PATH_EFFECTS + WEIGHT_EFFECTS + SIGNAL_EFFECTS)
#: What a path costs as a tone of a signal, on one core of the reference machine (docs/results/simulator.md).
TONE_S = 6e-6
_BIT = {name: 1 << index for index, name in enumerate(PATH_EFFECTS)}


def bit(name: str) -> int:
    """The bit of a path effect in `Paths.needs`."""
    return _BIT[name]


def bits(names: frozenset[str]) -> int:
    """The bits of all path effects among some names."""
    return sum(value for name, value in _BIT.items() if name in names)


def check_effects(names: frozenset[str]) -> frozenset[str]:
    """The same names; ValueError lists what is not known."""
    unknown = sorted(names - ALL_EFFECTS)
    if unknown:
        raise ValueError(f"effects: unknown {', '.join(unknown)}, known are {', '.join(sorted(ALL_EFFECTS))}")
    return names
