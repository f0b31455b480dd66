"""The fake night of the recorder's tests, and what that is made of, serve where recordings meet devices."""

from __future__ import annotations

import sys
from pathlib import Path

for room in ("cycle", "imaging", "reconstruction"):
    sys.path.append(str(Path(__file__).parents[1] / room))
