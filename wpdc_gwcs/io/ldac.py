"""FITS_LDAC: a table that contains a header as one long string, and a table of objects."""

import numpy as np
from astropy.io import fits

__all__ = ["write_ldac"]

_BEGIN = (("SIMPLE", True), ("BITPIX", -32))


def write_ldac(table, header, path):
    """Write a table as FITS_LDAC.

    Parameters
    ----------
    table : `~astropy.table.Table`
        The objects.
    header : `~astropy.io.fits.Header`
        Header of their image.
    path : path-like
        File to write.
    """
    # SCAMP rejects a header that does not begin like that of a file.
    header = fits.Header([*_BEGIN, *header.cards], copy=True) if "SIMPLE" not in header else header
    cards = [str(card).ljust(80).encode("ascii") for card in header.cards]
    cards.append(b"END".ljust(80))
    # Padded with blanks, because a NUL would end the header for readers in C.
    text = np.frombuffer(b"".join(cards), np.uint8).reshape(1, len(cards), 80)
    imhead = fits.BinTableHDU.from_columns(
        [fits.Column("Field Header Card", f"{text.size}B", dim=f"(80, {len(cards)})", array=text)],
        name="LDAC_IMHEAD",
    )
    imhead.header["TFORM1"] = f"{text.size}A"
    objects = fits.BinTableHDU(table, name="LDAC_OBJECTS")
    fits.HDUList([fits.PrimaryHDU(), imhead, objects]).writeto(path)
