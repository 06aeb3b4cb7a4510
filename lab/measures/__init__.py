"""Measures of answers: frames, objects, drives."""
