"""Alignment of the segmented mirrors of Cherenkov telescopes by the NAMOD method (arXiv:1605.06274)."""

__version__ = "0.1.0"
