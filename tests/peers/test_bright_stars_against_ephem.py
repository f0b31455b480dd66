"""The catalogue of bright stars beside PyEphem's own list of named stars (Hipparcos 1997, another reduction)."""

import numpy as np
import pytest

from namod_ctl.calibration.sky.star_catalogue import bright_stars

ephem_stars = pytest.importorskip("ephem.stars", reason="ephem is not installed (extra 'peers')")


def unit_vectors(ra_rad, dec_rad):
    return np.stack([np.cos(dec_rad) * np.cos(ra_rad), np.cos(dec_rad) * np.sin(ra_rad), np.sin(dec_rad)], axis=-1)


def test_named_stars_stand_where_ephem_has_them():
    """All its named stars are in the catalogue within 2 arcsec, half of them within 0.2, with the same magnitude."""
    catalogue = bright_stars()
    ours = catalogue.directions(2000.0)
    places, magnitudes = [], []
    for star in set(ephem_stars.stars.values()):
        star.compute("2000/1/1 12:00", epoch="2000")
        places.append((float(star.a_ra), float(star.a_dec)))
        magnitudes.append(float(star.mag))
    theirs = unit_vectors(*np.array(places).T)
    apart = np.linalg.norm(theirs[:, None] - ours[None], axis=2)
    nearest = apart.argmin(axis=1)
    apart_arcsec = np.degrees(apart.min(axis=1)) * 3600.0
    assert len(places) > 50
    assert np.median(apart_arcsec) < 0.2
    assert np.mean(apart_arcsec < 2.0) > 0.97
    assert np.median(np.abs(catalogue.v_mag[nearest] - magnitudes)) < 0.05
    assert np.mean(np.abs(catalogue.v_mag[nearest] - magnitudes) < 0.5) > 0.97
