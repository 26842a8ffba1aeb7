"""Figures of the page, as small files."""

import base64
import io

import numpy as np

from wpdc_gwcs import plotting

__all__ = ["detector_figures", "frame_figures"]

# Dots per inch and number of colors of the figures of a detector, of its color maps, which need
# more shades, and of figures that may be numerous; and the maximum number of stars drawn one by
# one.
_LARGE = {"dpi": 80, "colors": 64}
_MAPS = {"dpi": 80, "colors": 256}
_SMALL = {"dpi": 62, "colors": 16}
_MOST_STARS, _MOST_STARS_SMALL = 4000, 700


def detector_figures(name, solution, table, *, small=False):
    """Draw the pooled results of all frames of a detector.

    Parameters
    ----------
    name : str
        Name of the detector.
    solution : DistortionSolution or None
        Its solution.
    table : `~astropy.table.Table` or None
        Matches of all frames.
    small : bool, optional
        Whether to draw only the first figure, as a small file, because there are many detectors.

    Returns
    -------
    list of dict
        Figures, each with ``alt``, ``caption``, ``width``, ``height`` and ``data``.
    """
    figures = []
    if table is not None and len(table):
        if solution is not None:
            shape = solution.image_shape
            before = table.copy()
            at = np.array([table["x"], table["y"]], float)
            for axis, moved in zip("xy", np.array(solution.undistort(*at)), strict=True):
                before[f"d{axis}"] = table[f"d{axis}"] + table[axis] - moved
            axes = plotting.plot_before_after(
                before,
                table,
                image_shape=shape,
                titles=("distortion", "residuals"),
                n_points=_MOST_STARS_SMALL if small else _MOST_STARS,
            )
            figures.append(
                _embed(
                    axes[0, 0].figure,
                    f"distortion and residuals of {name}",
                    "Left: the distortion that is corrected.  Right: the residuals.  Arrows are "
                    "means of 20 x 20 cells.",
                    **(_SMALL if small else _LARGE),
                )
            )
        if small and figures:
            return figures
        if "phot_g_mean_mag" in table.colnames and np.isfinite(table["phot_g_mean_mag"]).any():
            axes = plotting.plot_magnitude(table)
            figures.append(
                _embed(
                    axes[0].figure,
                    f"residuals of {name} against magnitude",
                    "Residuals of all frames against magnitude; bars are 1 sigma.",
                )
            )
        figures.append(
            _embed(
                plotting.plot_cdf(table),
                f"distribution of the residuals of {name}",
                "Cumulative distribution of the residuals of all frames.",
            )
        )
    if solution is not None and solution.lookup_table is not None:
        figures.append(
            _embed(
                plotting.plot_lookup_table(solution.lookup_table),
                f"look-up table of {name}",
                "The look-up table.",
                **_MAPS,
            )
        )
    return figures


def frame_figures(name, table):
    """Draw the residuals of one frame.

    Parameters
    ----------
    name : str
        Name of the frame.
    table : `~astropy.table.Table`
        Its matches.

    Returns
    -------
    list of dict
        Figures, each with ``alt``, ``caption``, ``width``, ``height`` and ``data``.
    """
    shown, caption = table, None
    if len(table) > _MOST_STARS_SMALL:
        rows = np.random.default_rng(0).permutation(len(table))[:_MOST_STARS_SMALL]
        shown, caption = table[np.sort(rows)], f"{_MOST_STARS_SMALL} of {len(table)} stars."
    figure = plotting.plot_residuals_vs_position(shown)
    return [_embed(figure, f"residuals of {name}", caption, **_SMALL)]


def _embed(figure, alt, caption, *, dpi=_LARGE["dpi"], colors=_LARGE["colors"]):
    from PIL import Image

    raw = io.BytesIO()
    figure.savefig(raw, format="png", dpi=dpi)
    image = Image.open(raw).convert("RGB").quantize(colors, dither=Image.Dither.NONE)
    small = io.BytesIO()
    # A quarter smaller than PNG, and as exact.
    image.convert("RGB").save(small, format="webp", lossless=True)
    return {
        "alt": alt,
        "caption": caption,
        "width": image.width,
        "height": image.height,
        "data": base64.b64encode(small.getvalue()).decode("ascii"),
    }
