"""What the unit tests of store, cycle and imaging write and render serves here, too."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from campaign_lives import Nursery

sys.path.append(str(Path(__file__).parents[1] / "unit" / "store"))
sys.path.append(str(Path(__file__).parents[1] / "unit" / "cycle"))
sys.path.append(str(Path(__file__).parents[1] / "unit" / "imaging"))


@pytest.fixture(scope="session")
def nursery(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Nursery]:
    """Where the program is born again and again."""
    with Nursery(tmp_path_factory.mktemp("nursery") / "printed.txt") as nursery:
        yield nursery
