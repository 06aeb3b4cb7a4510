"""Photon counting: surfaces at 850 nm, fluxes, histograms of single-photon detectors."""
