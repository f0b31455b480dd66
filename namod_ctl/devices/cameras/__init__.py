"""Cameras a telescope really has, each behind `core.interfaces.Camera`; vendors' libraries are imported when used."""
