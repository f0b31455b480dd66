"""The cameras and frames that the unit tests of imaging are made of serve here, too."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "imaging"))
