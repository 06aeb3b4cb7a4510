"""Walls by finite differences in time (FDTD): reflection and transmission, smooth and rough, and the field itself."""

from sim_player.fdtd.experiment import Experiment, Transmission, transmission_experiment
from sim_player.fdtd.scattering import Scattered, reflect, reflect_angles

__all__ = ["Experiment", "Scattered", "Transmission", "reflect", "reflect_angles", "transmission_experiment"]
