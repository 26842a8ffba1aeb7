"""Inventory of a folder: its files, counted by kind."""

from collections import Counter

from wpdc_gwcs.columns import spelled_names
from wpdc_gwcs.counts import counted
from wpdc_gwcs.exceptions import InputError

__all__ = ["inventory_of"]

# Kinds by the ends of names: those of this package first, then the usual ones.
_ENDINGS = {
    ".wcs.asdf": "WCS",
    ".solution.asdf": "solution",
    ".camera.asdf": "camera",
    ".matches.ecsv": "match table",
    ".sources.ecsv": "source table",
    ".truth.ecsv": "truth table",
    ".ecsv": "table",
    ".csv": "table",
    ".tsv": "table",
    ".vot": "table",
    ".parquet": "table",
    ".head": "header",
    ".ahead": "header",
    ".hdr": "header",
}
# Other files are named as long as there are few.
_MOST_NAMES = 3


def inventory_of(folder):
    """Count the files of a folder.

    Parameters
    ----------
    folder : `~pathlib.Path`
        The folder.

    Returns
    -------
    str
        For example "4 FITS_LDAC lists, 2 images, 1 catalog, truth.asdf"; an empty text if there is
        nothing in it.  Hidden files do not count.
    """
    kinds, others = Counter(), []
    for path in sorted(folder.iterdir()):
        if path.name.startswith("."):
            continue
        kind = "folder" if path.is_dir() else _kind_of(path)
        if kind is None:
            others.append(path.name)
        else:
            kinds[kind] += 1
    told = [counted(n, kind) for kind, n in kinds.most_common()]
    if len(others) > _MOST_NAMES:
        others = [counted(len(others), "other file")]
    return ", ".join(told + others)


def _kind_of(path):
    """Singular of the kind of a file; `None` for a file that is best called by its name."""
    from wpdc_gwcs.io.files import file_kind

    name = path.name.lower()
    try:
        kind = file_kind(path)
    except InputError:
        return None
    if kind == "fits":
        return _kind_of_fits(path)
    return next((kind for ending, kind in _ENDINGS.items() if name.endswith(ending)), None)


def _kind_of_fits(path):
    from wpdc_gwcs.catalogs.positions import find_positions
    from wpdc_gwcs.io.companions import map_role, words_of
    from wpdc_gwcs.io.files import open_fits, stem_of
    from wpdc_gwcs.io.images import image_shape
    from wpdc_gwcs.io.sources import position_columns

    try:
        with open_fits(path, lazy=True) as hdus:
            if any(hdu.name == "LDAC_OBJECTS" for hdu in hdus):
                return "FITS_LDAC list"
            if any(hdu.is_image and image_shape(hdu.header) is not None for hdu in hdus):
                role = map_role(words_of(stem_of(path)))
                return "image" if role is None else f"{role} map"
            columns = [hdu.columns.names for hdu in hdus if hasattr(hdu, "columns")]
    except InputError:
        return "damaged FITS file"
    if any(position_columns(names) is not None for names in columns):
        return "source table"
    if any(find_positions(spelled_names(names)) is not None for names in columns):
        return "catalog"
    return "FITS table" if columns else "FITS header"
