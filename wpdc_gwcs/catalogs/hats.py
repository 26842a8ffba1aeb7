"""HATS: catalogs partitioned into Parquet files by HEALPix cell."""

import hashlib
import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from wpdc_gwcs.catalogs.cells import cells_in
from wpdc_gwcs.catalogs.files import READ_ERRORS
from wpdc_gwcs.catalogs.pieces import parquet_pieces, part_of
from wpdc_gwcs.exceptions import CatalogError
from wpdc_gwcs.extras import require

__all__ = ["HatsCatalog"]

_PARTITION = re.compile(r"Norder=(\d{1,2})/(?:Dir=\d+/)?Npix=(\d+)(?:\.parquet|/[^/]+\.parquet)$")
# Names of the properties file of a catalog, newest convention first.
_ABOUT = ("hats.properties", "properties", "catalog_info.json")


@dataclass(frozen=True)
class HatsCatalog:
    """A HATS catalog, of which only the needed partitions are read.

    Parameters
    ----------
    path : path-like
        Local folder of the catalog, or of a collection that contains it.

    Raises
    ------
    CatalogError
        If there is no such catalog.

    Examples
    --------
    >>> from wpdc_gwcs import HatsCatalog, calibrate
    >>> catalog = HatsCatalog("gaia_dr3")  # doctest: +SKIP
    >>> run = calibrate(frames, catalog)  # doctest: +SKIP
    """

    path: str | Path

    def __post_init__(self):
        folder = Path(self.path)
        if not folder.is_dir():
            raise CatalogError(
                f"hats:{self.path}: must be the folder of a catalog, is not a folder"
            )
        if not any((folder / name).is_file() for name in (*_ABOUT, "collection.properties")):
            raise CatalogError(
                f"hats:{self.path}: must be the folder of a catalog, with a file {_ABOUT[0]!r}"
            )

    def __str__(self):
        return f"hats:{self.path}"

    @cached_property
    def root(self):
        """Folder of the catalog itself, which may be part of a collection."""
        folder = Path(self.path)
        collection = folder / "collection.properties"
        if not collection.is_file():
            return folder
        name = _properties(collection).get("hats_primary_table_url", "")
        if not name or not (folder / name).is_dir():
            raise CatalogError(f"{collection}: names no catalog ('hats_primary_table_url')")
        return folder / name

    @cached_property
    def partitions(self):
        """Files of each partition by its order and number."""
        found = {}
        for path in sorted(self.root.rglob("*.parquet")):
            name = path.relative_to(self.root).as_posix()
            partition = _PARTITION.search(name)
            if partition is not None:
                found.setdefault((int(partition[1]), int(partition[2])), []).append(path)
        if not found:
            raise CatalogError(f"{self}: has no partitions (Norder=.../Npix=....parquet)")
        return found

    @property
    def identity(self):
        """Name of the catalog, the same for all regions."""
        digest = hashlib.sha256()
        for paths in self.partitions.values():
            for path in paths:
                stat = path.stat()
                name = path.relative_to(self.root)
                digest.update(f"{name} {stat.st_size} {stat.st_mtime_ns}\n".encode())
        return f"{self} {digest.hexdigest()}"

    def files_of(self, region):
        """Return the files that may have stars of a region.

        Parameters
        ----------
        region : Region
            Part of the sky.

        Returns
        -------
        list of `~pathlib.Path`
            The files of the partitions that the region touches.
        """
        require(str(self), "hats", "astropy_healpix", error=CatalogError)
        files = []
        for order in sorted({order for order, _ in self.partitions}):
            cells = np.array([cell for o, cell in self.partitions if o == order])
            for cell in cells_in(region, order, cells).tolist():
                files += self.partitions[order, cell]
        return files

    def stars_of(self, region):
        """Read the stars of a region.

        Parameters
        ----------
        region : Region
            Part of the sky.

        Returns
        -------
        `~astropy.table.Table`
            The columns of the catalog that `read_catalog` knows.

        Raises
        ------
        CatalogError
            If a partition cannot be read, or has no positions in degrees.
        """
        require(str(self), "hats", "pyarrow", "astropy_healpix", error=CatalogError)
        from wpdc_gwcs.catalogs.standard import known_names

        files = self.files_of(region)
        try:
            part = part_of(parquet_pieces(files, known_names()), region, sure=True)
        except READ_ERRORS as problem:
            raise CatalogError(f"{self}: a partition cannot be read: {problem}") from problem
        if part is None:
            raise CatalogError(f"{self}: partitions must have positions in degrees ('ra', 'dec')")
        return part.table


def _properties(path):
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    pairs = (line.partition("=") for line in lines if not line.startswith("#"))
    return {key.strip(): value.strip() for key, _, value in pairs}
