"""Bytes <-> messages of facet drives: no input or output, no clock, no logging, the standard library only."""
