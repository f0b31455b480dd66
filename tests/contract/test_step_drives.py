"""The contract of drives, for TMCL and Zaber drivers on the twin's electronics."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from drive_contract import DriveContract, DriveRig
from twin_rigs import tmcl_rig, zaber_rig


class TestTmclDrive(DriveContract):
    """TMCL on the twin's module."""

    @pytest.fixture
    def rig(self) -> DriveRig:
        return tmcl_rig()


class TestZaberDrive(DriveContract):
    """Zaber ASCII on the twin's controller."""

    @pytest.fixture
    def rig(self) -> DriveRig:
        return zaber_rig()
