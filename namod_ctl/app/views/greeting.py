"""What a newcomer sees who types nothing but the program's name."""

from __future__ import annotations

GREETING = """\
namod-ctl aligns the segmented mirror of a Cherenkov telescope with two cameras, by the NAMOD method.

New here? Three things to try; none needs a telescope:

  namod-ctl align --out CAMPAIGN
      aligns a mirror that stands wrong, a digital twin of FACT, in about a minute;
      then `namod-ctl report CAMPAIGN` writes down what was done

  namod-ctl record --twin --records 300 --out NIGHT
      records a star that wanders over the twin; then `namod-ctl reconstruct NIGHT`

  namod-ctl --help
      lists all commands; each of them explains itself, with an example: namod-ctl align --help

`namod-ctl --install-completion` lets the Tab key complete commands and options."""
