"""The Gaia archive: the stars of a region, queried cell by cell and cached on disk.

::

    region --> HEALPix cells --(kept already?)--> one query each --> file in the cache --> one table
"""

import contextlib
import hashlib
import logging
import os
import re
import tempfile
import time
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from astropy.table import Table, vstack

from wpdc_gwcs.catalogs.cells import cells_in, cells_of, circles_of
from wpdc_gwcs.catalogs.files import READ_ERRORS
from wpdc_gwcs.exceptions import CatalogError
from wpdc_gwcs.extras import require

__all__ = ["GaiaArchive"]

log = logging.getLogger(__name__)

_ESA = "https://gea.esac.esa.int/tap-server/tap"
_TABLE = "gaiadr3.gaia_source"
# Columns that a calibration uses: 22 of 152.
_COLUMNS = (
    *("source_id", "ref_epoch", "ra", "dec", "pmra", "pmdec", "parallax", "radial_velocity"),
    *("ra_error", "dec_error", "pmra_error", "pmdec_error", "parallax_error", "ruwe"),
    *("ra_dec_corr", "ra_pmra_corr", "ra_pmdec_corr"),
    *("dec_pmra_corr", "dec_pmdec_corr", "pmra_pmdec_corr"),
    *("phot_g_mean_mag", "bp_rp"),
)
# Fainter stars have proper motion errors of 1 mas / yr and more: useless some years later.
_FAINTEST = 20.5
# Cells of 0.8 square degrees: one to four per frame, and up to a million stars in dense fields.
_ORDER = 6
# Without an explicit limit, some services stop at 2000 rows.
_MOST_ROWS = 5_000_000
# s to wait before each try
_WAITS = (0.0, 2.0, 10.0)
# s to connect, and s to wait for an answer: queries may be queued
_TIMEOUTS = (15.0, 300.0)
# HTTP status of services without asynchronous jobs, which return results at once.
_NO_JOBS = (404, 405, 501)


@dataclass(frozen=True)
class GaiaArchive:
    """Gaia DR3 in an archive with a TAP service; answers are cached on disk.

    Parameters
    ----------
    url : str, optional
        Address of the service; default: ``WPDC_GWCS_TAP_URL`` of the environment, else that of the
        Gaia archive at ESA.
    cache : path-like, optional
        Cache folder; default: ``WPDC_GWCS_CACHE`` of the environment, else the cache folder that
        astropy would use for this package.
    max_mag : float, optional
        G magnitude of the faintest stars to request; default: 20.5.
    table : str, optional
        Table of the service, with the columns of ``gaia_source``; default: that of Gaia DR3.

    Examples
    --------
    >>> from wpdc_gwcs.catalogs import GaiaArchive
    >>> print(GaiaArchive(url="https://gaia.aip.de/tap", max_mag=19.0))
    gaiadr3.gaia_source at https://gaia.aip.de/tap, G <= 19
    """

    url: str | None = None
    cache: str | Path | None = None
    max_mag: float = _FAINTEST
    table: str = _TABLE

    def __post_init__(self):
        url = self.url or os.environ.get("WPDC_GWCS_TAP_URL") or _ESA
        if not re.match(r"https?://[^/\s]+", url):
            raise CatalogError(
                f"the address of a TAP service must begin with http:// or https://, got {url!r}"
            )
        object.__setattr__(self, "url", url.rstrip("/"))
        if not re.fullmatch(r"[\w.\"]+", self.table):
            raise CatalogError(
                f"the table of a TAP service must be a plain name, got {self.table!r}"
            )
        if not np.isfinite(self.max_mag):
            raise CatalogError(f"max_mag must be a finite magnitude, got {self.max_mag}")

    def __str__(self):
        return f"{self.table} at {self.url}, G <= {self.max_mag:g}"

    @property
    def identity(self):
        """Name of the service and its limits, the same for all regions."""
        return str(self)

    def stars_of(self, region):
        """Get the stars of a region.

        Parameters
        ----------
        region : Region
            Part of the sky.

        Returns
        -------
        `~astropy.table.Table`
            Columns as in the archive; only stars of this region.

        Raises
        ------
        CatalogError
            If the archive does not answer, refuses the query or returns only a part of the stars;
            the message says what to do.
        """
        require("--catalog gaia", "gaia", "pyvo", "astropy_healpix", error=CatalogError)
        cells = cells_in(region, _ORDER)
        folder = self._folder()
        found = {cell: self._kept(folder, cell) for cell in cells.tolist()}
        missing = [cell for cell, table in found.items() if table is None]
        if missing:
            log.info(
                "asking %s for %d of %d cells of the sky (%s has the others)",
                *(self, len(missing), len(cells), folder),
            )
        for number, cell in enumerate(missing, 1):
            began = time.perf_counter()
            found[cell] = self._ask(cell)
            _keep(found[cell], folder / f"Npix={cell}-G{self.max_mag:g}.fits")
            log.info(
                "cell %d of %d: %d stars in %.1f s",
                *(number, len(missing), len(found[cell]), time.perf_counter() - began),
            )
        stars = vstack(list(found.values()), metadata_conflicts="silent")
        ra, dec = (np.asarray(stars[name], float) for name in ("ra", "dec"))
        return stars[region.contains(ra, dec)]

    def _folder(self):
        root = self.cache or os.environ.get("WPDC_GWCS_CACHE")
        if not root:
            from astropy.config import get_cache_dir

            try:
                root = get_cache_dir("wpdc_gwcs")
            except OSError as problem:
                root = tempfile.gettempdir()
                log.warning("no cache folder (%s): %s is used", problem, root)
        # Each service has its own cache: their contents differ.
        service = hashlib.sha256(f"{self.url} {self.table}".encode()).hexdigest()[:8]
        return Path(root) / "gaia" / f"{self.table.replace(chr(34), '')}-{service}"

    def _kept(self, folder, cell):
        """Table of a cell from disk, or None; a deeper cached table will do."""
        kept = {}
        for path in folder.glob(f"Npix={cell}-G*.fits"):
            with contextlib.suppress(ValueError):
                kept[float(path.stem.partition("-G")[2])] = path
        for limit in sorted(limit for limit in kept if limit >= self.max_mag):
            try:
                table = Table.read(kept[limit], format="fits", mask_invalid=False)
            except READ_ERRORS as problem:
                log.info("%s: cannot be read and is requested again: %s", kept[limit], problem)
                continue
            if set(_COLUMNS) <= set(table.colnames):
                return table[np.asarray(table["phot_g_mean_mag"]) <= self.max_mag]
        return None

    def _ask(self, cell):
        import pyvo
        import requests

        (ra,), (dec,), (radius,) = circles_of(_ORDER, [cell])
        query = (
            f"SELECT {', '.join(_COLUMNS)} FROM {self.table} WHERE 1 = CONTAINS("
            f"POINT('ICRS', ra, dec), CIRCLE('ICRS', {ra:.8f}, {dec:.8f}, {radius:.8f})) "
            f"AND phot_g_mean_mag <= {self.max_mag:g}"
        )
        problem = None
        for wait in _WAITS:
            if problem is not None:
                log.info("%s: %s: trying again in %g s", self.url, problem, wait)
                time.sleep(wait)
            try:
                table = _answer(self.url, query)
                break
            except pyvo.dal.DALQueryError as refusal:
                raise CatalogError(f"{self.url} refuses the query: {_line(refusal)}") from refusal
            except pyvo.dal.DALOverflowWarning as overflow:
                raise CatalogError(
                    f"{self.url} does not return all stars of a cell of 0.8 square degrees: ask "
                    f"for fewer (--max-mag, now {self.max_mag:g}), or another service (--tap-url)"
                ) from overflow
            except (pyvo.dal.DALAccessError, requests.RequestException, *READ_ERRORS) as error:
                problem = _line(error)
        else:
            raise CatalogError(
                f"{self.url} did not answer in {len(_WAITS)} tries: {problem}; name another "
                "service (--tap-url), or make a file on a machine with a network ('wpdc catalog "
                "prepare gaia') and give it as --catalog"
            )
        lacking = set(_COLUMNS) - set(table.colnames)
        if lacking:
            raise CatalogError(
                f"{self.url} does not return the columns {', '.join(sorted(lacking))}"
            )
        table = Table(table)[list(_COLUMNS)]
        ra, dec = (np.asarray(table[name], float) for name in ("ra", "dec"))
        return table[cells_of(_ORDER, ra, dec) == cell]


def _answer(url, query):
    import pyvo

    with warnings.catch_warnings():
        # VOTables that deviate slightly from the standard are fine; missing rows are an error.
        warnings.simplefilter("ignore")
        warnings.simplefilter("error", pyvo.dal.DALOverflowWarning)
        with _session() as session:
            service = pyvo.dal.TAPService(url, session=session)
            try:
                result = service.run_async(query, maxrec=_MOST_ROWS)
            except pyvo.dal.DALServiceError as error:
                if getattr(error, "code", None) not in _NO_JOBS:
                    raise
                result = service.run_sync(query, maxrec=_MOST_ROWS)
        return result.to_table()


def _session():
    import requests

    class Session(requests.Session):
        def request(self, *args, **kwargs):
            kwargs["timeout"] = _TIMEOUTS
            return super().request(*args, **kwargs)

    return Session()


def _keep(table, path):
    """Write a cell to the cache atomically; an unusable cache is not an error."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(".tmp", dir=path.parent)
        os.close(handle)
        try:
            plain = Table(table, meta={})
            plain.write(temporary, format="fits", overwrite=True)
            os.replace(temporary, path)
        except BaseException:
            os.unlink(temporary)
            raise
    except OSError as problem:
        log.warning("the answer of the archive cannot be cached: %s", problem)


def _line(error):
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= 200 else text[:197] + "..."
