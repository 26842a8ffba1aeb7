"""TPV for SWarp; truth is its three steps, written out with astropy.wcs, and SWarp itself."""

import shutil
import subprocess
import warnings

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS

from wpdc_gwcs.cli.app import run
from wpdc_gwcs.export import make_form
from wpdc_gwcs.export.tpv import nearest_polynomial, tpv_keywords
from wpdc_gwcs.io import write
from wpdc_gwcs.io.fits import write_form
from wpdc_gwcs.models import PVPolynomial, project, pv_terms
from wpdc_gwcs.solution import DistortionSolution


def make_solution(*, corner, degree=7, n=1000, seed=2, radial=False):
    """Give a solution with `corner` px of distortion at its corners."""
    rng = np.random.default_rng(seed)
    scale = 0.1 / 3600
    terms = pv_terms(degree, radial)
    total = terms.own + terms.other + terms.radius
    pv = rng.normal(size=(2, len(total))) * 3.0 ** (2 - total) / (scale * n / 2) ** (total - 1)
    pv[:, total < 2] = 0.0
    ends = np.array([[-1, 1, 1, -1], [-1, -1, 1, 1]]) * scale * n / 2
    make = PVPolynomial.from_coefficients
    size = np.hypot(*make(pv, degree=degree, radial=radial)(*ends)).max()
    pv *= corner * scale / size
    pv[:, 1] = 1.0
    return DistortionSolution(
        detector="a",
        image_shape=(n, n + 20),
        crpix=[n / 2, n / 2 + 3.0],
        cd=scale * np.array([[-0.9, 0.1], [0.1, 1.0]]),
        crval=[150.0, 30.0],
        pv=make(pv, degree=degree, radial=radial),
    )


def three_steps(solution, header):
    """Greatest distance of SWarp's pixels, by PV as astropy has it, px."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        wcs = WCS(header)
    cd = np.array([[header[f"CD{i}_{j}"] for j in (1, 2)] for i in (1, 2)])
    crpix = np.array([[header["CRPIX1"]], [header["CRPIX2"]]]) - 1
    ny, nx = solution.image_shape
    edges = [np.linspace(-0.5, size - 0.5, 67) for size in (nx, ny)]
    pixels = np.array([v.ravel() for v in np.meshgrid(*edges)])
    plane = np.array(project(*solution.wcs(*pixels, with_bounding_box=False), solution.crval))
    u = plane
    for _ in range(3):
        sky = wcs.all_pix2world(*(np.linalg.solve(cd, u) + crpix), 0)
        u = u - (np.array(project(*sky, solution.crval)) - plane)
    return np.hypot(*(np.linalg.solve(cd, u) + crpix - pixels)).max()


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("corner", "degree"), [(20.0, 7), (20.0, 3), (60.0, 5)])
def test_the_linear_part_is_what_swarp_needs(corner, degree, seed):
    solution = make_solution(corner=corner, degree=degree, seed=seed)
    made = make_form(solution, "tpv")
    assert made.deviation < 1e-4
    assert three_steps(solution, made.header) == pytest.approx(made.swarp_deviation, rel=0.05)
    before = three_steps(solution, tpv_keywords(solution, nearest_polynomial(solution)[0]))
    assert made.swarp_deviation < before / 2.5


def test_the_linear_part_stays_where_nothing_is_gained():
    solution = make_solution(corner=1.5)
    made = make_form(solution, "tpv")
    assert made.swarp_deviation < 1e-3
    assert [made.header["CRPIX1"], made.header["CRPIX2"]] == list(solution.crpix + 1)
    assert made.header["CD1_2"] == solution.cd[0, 1]
    # Radial terms belong to their center.
    solution = make_solution(corner=30.0, radial=True)
    made = make_form(solution, "tpv")
    assert made.header["CRPIX1"] == solution.crpix[0] + 1
    assert made.header["PV1_39"] == solution.pv.coefficients[0, -1]
    assert three_steps(solution, made.header) == pytest.approx(made.swarp_deviation, rel=0.05)


def test_where_swarp_makes_no_steps_nothing_is_said():
    # They would be off by more than 1e-3 deg, and it takes a polynomial of its own.
    made = make_form(make_solution(corner=200.0, n=400), "tpv")
    assert made.deviation < 1e-3
    assert made.swarp_deviation is None


@pytest.mark.parametrize("form", ["tpv", "head"])
def test_the_command_tells_it(tmp_path, capsys, form):
    solution = make_solution(corner=40.0)
    write(solution, tmp_path / "a.solution.asdf")
    out = tmp_path / ("a.head" if form == "head" else "a.fits")
    command = ["export", tmp_path / "a.solution.asdf", "--format", form, "--output", out]
    assert run([str(part) for part in command]) == 0
    told = make_form(solution, form).swarp_deviation
    assert f"px, in SWarp {told:.2g} px)" in capsys.readouterr().out
    assert f"that of SWarp: {told:.3g} px" in out.read_bytes().decode()


@pytest.mark.skipif(shutil.which("SWarp") is None, reason="needs SWarp")
def test_swarp_itself(tmp_path):
    solution = make_solution(corner=40.0)
    made = write_form(solution, tmp_path / "a.fits", form="tpv")
    header, (ny, nx) = fits.getheader(tmp_path / "a.fits"), solution.image_shape
    distances = []
    for axis, size in ((0, nx), (1, ny)):
        ramp = np.arange(size, dtype=np.float32)
        ramp = np.broadcast_to(ramp if axis == 0 else ramp[:, None], (ny, nx))
        fits.writeto(tmp_path / "b.fits", ramp, header, overwrite=True)
        options = "-SUBTRACT_BACK N -RESAMPLING_TYPE BILINEAR -PROJECTION_ERR 0.0 -WRITE_XML N"
        subprocess.run(
            f"SWarp b.fits -c /dev/null -FSCALASTRO_TYPE NONE {options}".split(),
            cwd=tmp_path,
            check=True,
            capture_output=True,
        )
        values = fits.getdata(tmp_path / "coadd.fits")
        v, u = np.nonzero(fits.getdata(tmp_path / "coadd.weight.fits"))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            sky = WCS(fits.getheader(tmp_path / "coadd.fits")).all_pix2world(u, v, 0)
        place = np.array(solution.wcs.invert(*sky))
        inside = (place > 2).all(axis=0) & (place[0] < nx - 3) & (place[1] < ny - 3)
        distances.append((values[v, u] - place[axis])[inside])
    # Of float32, 1e-4 px at 1000.
    worst = np.hypot(*distances).max()
    assert 0.7 * made.swarp_deviation < worst < 1.05 * made.swarp_deviation + 2e-4
