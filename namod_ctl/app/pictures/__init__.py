"""Figures of point spread functions and their style."""
