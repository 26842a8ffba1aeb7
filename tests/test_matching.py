"""Matching: the right pairs, or a refusal that says why."""

from dataclasses import FrozenInstanceError

import numpy as np
import pytest
from astropy import units as u
from astropy.table import QTable, Table
from astropy.wcs import WCS

from wpdc_gwcs.exceptions import MatchError
from wpdc_gwcs.matching import match_planes, match_sources, pair_nearest

SHAPE = (2048, 2048)


def make_field(
    seed=1,
    *,
    n=400,
    shape=SHAPE,
    shift=(60.0, -40.0),
    rotation=0.5,
    scale=1.005,
    distortion=30.0,
    lost=0.05,
    spurious=0.15,
    noise=0.05,
    surplus=1.0,
):
    """Reference stars and sources with a cubic distortion, and who is who.

    The reference covers twice the frame's width; a quarter of it is on the frame.  Brightness is in
    magnitudes; spurious sources are faint.
    """
    rng = np.random.default_rng(seed)
    ny, nx = shape
    half = 0.5 * max(nx, ny)
    n_all = int(4 * n * surplus)
    x = rng.uniform(-0.5 * nx, 1.5 * nx, n_all)
    y = rng.uniform(-0.5 * ny, 1.5 * ny, n_all)
    mag = 20 + np.log10(rng.uniform(0.01, 1, n_all)) * 2
    a, b = rng.normal(size=(2, 7)) * [1, 1, 1, 0.6, 0.6, 0.6, 0.6]

    def distort(px, py):
        p, q = (px - nx / 2) / half, (py - ny / 2) / half
        terms = np.array([p * p, p * q, q * q, p**3, p * p * q, p * q * q, q**3])
        corners = np.array([[1, s, 1, 1, s, 1, s] for s in (-1, 1)])
        gain = distortion / max(np.hypot(corners @ a, corners @ b).max(), 1e-9)
        r = np.deg2rad(rotation)
        u_, v_ = px - nx / 2, py - ny / 2
        return (
            nx / 2 + shift[0] + scale * (np.cos(r) * u_ - np.sin(r) * v_) + gain * (a @ terms),
            ny / 2 + shift[1] + scale * (np.sin(r) * u_ + np.cos(r) * v_) + gain * (b @ terms),
        )

    found = np.flatnonzero((rng.uniform(size=n_all) > lost) & (np.arange(n_all) < 4 * n))
    xs, ys = distort(x[found], y[found])
    on = (xs > 0) & (xs < nx - 1) & (ys > 0) & (ys < ny - 1)
    found, xs, ys = found[on], xs[on], ys[on]
    m = int(spurious * len(found))
    xs = np.append(xs + rng.normal(size=len(xs)) * noise, rng.uniform(0, nx, m))
    ys = np.append(ys + rng.normal(size=len(ys)) * noise, rng.uniform(0, ny, m))
    true = np.append(found, np.full(m, -1))
    flux = 10 ** (-0.4 * np.append(mag[found], rng.uniform(19, 20, m)))
    order = rng.permutation(len(xs))
    return {
        "xs": xs[order],
        "ys": ys[order],
        "xr": x,
        "yr": y,
        "flux": flux[order],
        "mag": mag,
        "true": true[order],
        "shape": shape,
    }


def run(field, *, brightness=True, **options):
    more = {"flux": field["flux"], "mag": field["mag"]} if brightness else {}
    return match_planes(
        field["xs"],
        field["ys"],
        field["xr"],
        field["yr"],
        image_shape=field["shape"],
        **more,
        **options,
    )


def assert_right(field, i, j, *, recall=0.99, false=0.0):
    true = field["true"]
    assert (true[i] == j).sum() >= recall * (true >= 0).sum()
    assert (true[i] != j).sum() <= false * len(i)
    assert len(np.unique(i)) == len(i)
    assert len(np.unique(j)) == len(j)


@pytest.mark.parametrize("brightness", [True, False])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_planes_finds_all_pairs(seed, brightness):
    field = make_field(seed)
    i, j, diagnostics = run(field, brightness=brightness)
    assert_right(field, i, j)
    assert (np.diff(i) > 0).all()
    assert diagnostics.n_pairs == len(i)
    assert diagnostics.purity > 0.99
    assert diagnostics.significance > 20
    assert diagnostics.scatter == pytest.approx(0.05, rel=0.25)


def test_planes_reports_the_header_error():
    field = make_field(4, shift=(100.0, -70.0), rotation=0.8, scale=0.99, distortion=0.0)
    diagnostics = run(field)[2]
    # the mapping goes from the sources to the reference: the inverse of what was put in
    assert diagnostics.rotation == pytest.approx(-0.8, abs=1e-3)
    assert diagnostics.scale == pytest.approx(1 / 0.99, abs=1e-5)
    inverse = np.linalg.inv(
        0.99
        * np.array(
            [
                [np.cos(0.8 * u.deg), -np.sin(0.8 * u.deg)],
                [np.sin(0.8 * u.deg), np.cos(0.8 * u.deg)],
            ]
        )
    )
    assert diagnostics.shift == pytest.approx(inverse @ [-100.0, 70.0], abs=0.5)
    assert diagnostics.parity == 1


def test_pair_nearest_matches_brute_force(rng):
    xs, ys = rng.uniform(0, 30, (2, 150))
    xr, yr = rng.uniform(0, 30, (2, 150))
    i, j, n_ambiguous = pair_nearest(xs, ys, xr, yr, 1.0)
    near = np.hypot(xs[:, None] - xr, ys[:, None] - yr) <= 1.0
    alone = near & (near.sum(1) == 1)[:, None] & (near.sum(0) == 1)[None]
    assert sorted(zip(i, j)) == sorted(zip(*np.nonzero(alone)))
    assert n_ambiguous == near.any(1).sum() - alone.any(1).sum()


def test_sources_returns_table(rng):
    field = make_field(5)
    wcs = make_wcs()
    ra, dec = wcs.pixel_to_world_values(field["xr"], field["yr"])
    sources = Table({"x": field["xs"], "y": field["ys"], "flux": field["flux"]})
    catalog = QTable({"ra": ra * u.deg, "dec": dec * u.deg, "phot_g_mean_mag": field["mag"]})
    matches, diagnostics = match_sources(sources, catalog, wcs, image_shape=SHAPE)
    assert_right(field, matches["source_index"], matches["catalog_index"])
    assert matches["separation"].unit == u.pix
    assert np.median(matches["separation"]) < 0.2 * u.pix
    assert matches.meta["evidence"]["n_pairs"] == len(matches)
    with pytest.raises(FrozenInstanceError):
        diagnostics.n_pairs = 0


def make_wcs(shape=SHAPE):
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    wcs.wcs.crval = [150.0, -40.0]
    wcs.wcs.crpix = [0.5 * (shape[1] + 1), 0.5 * (shape[0] + 1)]
    wcs.wcs.cd = np.array([[-1.0, 0.02], [0.02, 1.0]]) * 0.2 / 3600
    wcs.wcs.radesys = "ICRS"
    return wcs


def test_refuses_another_field():
    field, other = make_field(6), make_field(7)
    field["xr"], field["yr"], field["mag"] = other["xr"], other["yr"], other["mag"]
    with pytest.raises(MatchError, match=r"no match with sufficient evidence.*blind=True"):
        run(field)
