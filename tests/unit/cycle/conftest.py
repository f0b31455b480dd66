"""The cameras and frames that the unit tests of imaging are made of, and the made runs of reconstruction serve here."""

from __future__ import annotations

import sys
from pathlib import Path

for room in ("imaging", "reconstruction"):
    sys.path.append(str(Path(__file__).parents[1] / room))
