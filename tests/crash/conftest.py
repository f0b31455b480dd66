"""What the unit tests of store, cycle and imaging write and render serves here, too."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "unit" / "store"))
sys.path.append(str(Path(__file__).parents[1] / "unit" / "cycle"))
sys.path.append(str(Path(__file__).parents[1] / "unit" / "imaging"))
