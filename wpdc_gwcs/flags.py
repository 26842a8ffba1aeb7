"""Bits of the column ``flags`` of a table of sources."""

__all__ = [
    "FLAG_BAD_PIXEL",
    "FLAG_BLENDED",
    "FLAG_COSMIC",
    "FLAG_EDGE",
    "FLAG_EXTENDED",
    "FLAG_FIT_FAILED",
    "FLAG_NAMES",
    "FLAG_SATURATED",
]

FLAG_SATURATED = 1  # a pixel of the core is at the saturation level
FLAG_EDGE = 2  # the core reaches over the edge of the image
FLAG_BLENDED = 4  # a neighbor disturbs the core
FLAG_COSMIC = 8  # sharper than the PSF: cosmic ray or hot pixel
FLAG_EXTENDED = 16  # broader than the PSF: galaxy, or an unresolved blend
FLAG_BAD_PIXEL = 32  # a masked pixel within the core
FLAG_FIT_FAILED = 64  # the PSF does not fit: no star, or the windowed centroid was kept

# Names for messages.
FLAG_NAMES = {
    FLAG_SATURATED: "saturated",
    FLAG_EDGE: "at the edge",
    FLAG_BLENDED: "blended",
    FLAG_COSMIC: "sharper than stars",
    FLAG_EXTENDED: "broader than stars",
    FLAG_BAD_PIXEL: "with bad pixels",
    FLAG_FIT_FAILED: "unlike the PSF",
}
