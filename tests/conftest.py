import os
import shutil
import subprocess
import warnings
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS

os.environ.setdefault("MPLBACKEND", "agg")

REPOSITORY = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def shared_data():
    """Folder of real frames and headers; tests that need it are skipped where it is absent."""
    folder = Path(os.environ.get("WPDC_GWCS_DATA") or REPOSITORY.parent / "shared" / "data")
    if not folder.is_dir():
        pytest.skip(f"test data not found: {folder}")
    return folder


@pytest.fixture
def rng():
    """A random generator that is the same in every run."""
    return np.random.default_rng(20160101)


@pytest.fixture
def resample():
    """A function of an image that SWarp resamples: values, and where on the sky they are."""
    swarp = next((p for name in ("SWarp", "swarp") if (p := shutil.which(name))), None)
    if swarp is None:
        pytest.skip("SWarp is not installed")
    options = {
        "SUBTRACT_BACK": "N",
        "RESAMPLING_TYPE": "BILINEAR",
        "PROJECTION_ERR": "0.0",
        "FSCALASTRO_TYPE": "NONE",
        "WRITE_XML": "N",
        "VERBOSE_TYPE": "QUIET",
        "DELETE_TMPFILES": "Y",
    }
    arguments = [a for key, value in options.items() for a in (f"-{key}", value)]

    def run(path):
        subprocess.run(
            [swarp, path.name, "-c", "/dev/null", *arguments],
            cwd=path.parent,
            check=True,
            capture_output=True,
            timeout=60,
        )
        values, weights = (
            fits.getdata(path.with_name(name)) for name in ("coadd.fits", "coadd.weight.fits")
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            wcs = WCS(fits.getheader(path.with_name("coadd.fits")))
        v, u = np.nonzero(weights > 0.99 * weights.max())
        return values[v, u], wcs.all_pix2world(u, v, 0)

    return run
