"""Calibrations of cameras, optics and structure: pure estimators."""
