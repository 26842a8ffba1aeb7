"""Simulations in files: frames and a catalog for the command line, and the truth.

::

    NAME.ldac | NAME.cat.ecsv + NAME.hdr | NAME.fits     the measurement
    CAMERA-reference.fits                                the reference catalog
    truth.asdf, NAME.truth.ecsv                          the truth: an exact WCS, star by star
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from astropy import units as u
from astropy.io import fits
from astropy.table import Table

from wpdc_gwcs.io.files import OutputExistsError, atomic_path, make_folder
from wpdc_gwcs.io.ldac import write_ldac
from wpdc_gwcs.io.tables import read_table, write_table
from wpdc_gwcs.io.truth import read_truths, write_truths

__all__ = ["Truth", "read_truth", "write_simulation"]

TRUTH = "truth.asdf"
_UNITS = {"x": u.pix, "y": u.pix, "ra": u.deg, "dec": u.deg, "magnitude": u.mag, "color": u.mag}


@dataclass(frozen=True, eq=False)
class Truth:
    """The truth about the frames of a simulation, read from its folder.

    Parameters
    ----------
    folder : Path
        Folder of the simulation.
    camera : str
        Name of the camera.
    catalog : Path
        Path of the reference catalog.
    frames : dict
        `~wpdc_gwcs.simulation.FrameTruth` of each frame, by name.
    files : dict
        Path of each frame for ``wpdc calibrate``, by name.

    Examples
    --------
    >>> import tempfile
    >>> from wpdc_gwcs import simulate
    >>> from wpdc_gwcs.simulation import read_truth, write_simulation
    >>> sky = simulate(1, image_shape=(128, 128), density=60, distortion=2, seed=1)
    >>> folder = tempfile.mkdtemp()
    >>> files = write_simulation(sky, folder, images=())
    >>> truth = read_truth(folder)
    >>> list(truth.frames), truth.stars("sim-01").colnames
    (['sim-01'], ['x', 'y', 'ra', 'dec', 'magnitude', 'catalog_index', 'source_index'])
    """

    folder: Path
    camera: str
    catalog: Path
    frames: dict
    files: dict

    def stars(self, name):
        """Read the truth about a frame star by star.

        Parameters
        ----------
        name : str
            Name of the frame.

        Returns
        -------
        `~astropy.table.Table`
            Stars on the detector: ``x``, ``y`` in px, ``ra``, ``dec`` in deg at the epoch of the
            frame, ``magnitude``, ``color`` if stars have colors, ``catalog_index`` (zero-based row
            of the reference, -1 for stars that it does not have) and, for source lists,
            ``source_index`` (zero-based row of the list, -1 for stars that were not detected).
        """
        return read_table(
            self.folder / f"{name}.truth.ecsv",
            columns=("x", "y", "ra", "dec", "magnitude", "catalog_index"),
        )


def read_truth(folder):
    """Read the truth about a simulation.

    Parameters
    ----------
    folder : path-like
        Folder that was written by `write_simulation`.

    Returns
    -------
    Truth
        The truth; tables of stars are read when they are requested.

    Raises
    ------
    FileFormatError
        If the truth is missing or damaged.

    Examples
    --------
    >>> import tempfile
    >>> from wpdc_gwcs import simulate
    >>> from wpdc_gwcs.simulation import read_truth, write_simulation
    >>> sky = simulate(1, image_shape=(128, 128), density=60, distortion=2, seed=1)
    >>> folder = tempfile.mkdtemp()
    >>> files = write_simulation(sky, folder, images=())
    >>> frame = read_truth(folder).frames["sim-01"]
    >>> [round(float(d), 6) for d in frame.error_at(sky.exposures[0].sky, 10.0, 20.0)]
    [0.0, 0.0]
    """
    folder = Path(folder)
    tree, frames = read_truths(folder / TRUTH)
    files = {name: folder / node["file"] for name, node in tree["frames"].items()}
    return Truth(folder, tree["camera"], folder / tree["catalog"], frames, files)


def write_simulation(
    simulation,
    directory,
    *,
    images=(0,),
    sources="ecsv",
    overwrite=False,
    progress=None,
    **render_options,
):
    """Write a simulation to files for ``wpdc calibrate``, together with the truth about it.

    Parameters
    ----------
    simulation : Simulation
        The simulation.
    directory : path-like
        Folder to write to; made if needed.
    images : sequence of int, optional
        Exposures (counted from 0) to write as rendered images; the others become source lists.
    sources : {"ecsv", "ldac"}, optional
        Form of the source lists: a table and a text header, or FITS_LDAC.
    overwrite : bool, optional
        Whether existing files may be replaced.
    progress : callable, optional
        Called as ``progress("write", done, total)`` after each frame.
    **render_options
        Passed to `~wpdc_gwcs.simulation.SimulatedExposure.render`.

    Returns
    -------
    dict
        ``"reference"``: path of the catalog; ``"frames"``: list with one path per exposure, image
        or source list; ``"headers"``: list of paths of the text headers, `None` for a frame that
        has its own; ``"truth"``: path of the exact WCSs.  The tables of the stars of each frame
        are in the same folder.

    Raises
    ------
    ValueError
        If the form of the source lists is unknown.
    FileExistsError
        If a file exists and ``overwrite`` is not set.
    InputError
        If the folder cannot be written to.

    Examples
    --------
    >>> import tempfile
    >>> from wpdc_gwcs import simulate
    >>> from wpdc_gwcs.simulation import write_simulation
    >>> sky = simulate(2, image_shape=(128, 128), density=60, distortion=2, seed=1)
    >>> files = write_simulation(sky, tempfile.mkdtemp(), images=(0,))
    >>> [path.name for path in files["frames"]], files["reference"].name
    (['sim-01.fits', 'sim-02.cat.ecsv'], 'sim-reference.fits')
    """
    if sources not in ("ecsv", "ldac"):
        raise ValueError(f"sources must be 'ecsv' or 'ldac', not {sources!r}")
    directory = Path(directory)
    suffix = {"ecsv": ".cat.ecsv", "ldac": ".ldac"}[sources]
    catalog, truth = directory / f"{simulation.camera.name}-reference.fits", directory / TRUTH
    frames, headers, tables = [], [], []
    for k, exposure in enumerate(simulation.exposures):
        is_image = k in images
        frames.append(directory / (exposure.name + (".fits" if is_image else suffix)))
        has_own = is_image or sources == "ldac"
        headers.append(None if has_own else directory / f"{exposure.name}.hdr")
        tables.append(directory / f"{exposure.name}.truth.ecsv")
    for path in [catalog, truth, *frames, *tables, *(h for h in headers if h is not None)]:
        if path.exists() and not overwrite:
            raise OutputExistsError(f"{path}: file exists and is kept")
    make_folder(directory)
    with atomic_path(catalog, overwrite=overwrite) as temporary:
        simulation.reference.write(temporary, format="fits")
    for k, exposure in enumerate(simulation.exposures):
        listed, stars = exposure.observe()
        if k in images:
            image = exposure.render(**render_options)
            with atomic_path(frames[k], overwrite=overwrite) as temporary:
                fits.writeto(temporary, image, exposure.header)
            stars.remove_column("source_index")
        elif sources == "ecsv":
            listed.meta["pixels"] = "zero based"
            write_table(listed, frames[k], overwrite=overwrite)
            with atomic_path(headers[k], overwrite=overwrite) as temporary:
                exposure.header.totextfile(temporary)
        else:
            with atomic_path(frames[k], overwrite=overwrite) as temporary:
                _write_sources(listed, exposure.header, temporary)
        stars.rename_column("reference_index", "catalog_index")
        for name in stars.colnames:
            stars[name].unit = _UNITS.get(name)
        write_table(stars, tables[k], overwrite=overwrite)
        if progress is not None:
            progress("write", k + 1, len(frames))
    write_truths(
        simulation.exposures,
        truth,
        camera=simulation.camera.name,
        catalog=catalog.name,
        files=[(p.name, "image" if k in images else "list") for k, p in enumerate(frames)],
        overwrite=overwrite,
    )
    return {"reference": catalog, "frames": frames, "headers": headers, "truth": truth}


def _write_sources(s, header, path):
    columns = {
        "XWIN_IMAGE": s["x"] + 1,  # FITS_LDAC counts pixels from 1
        "YWIN_IMAGE": s["y"] + 1,
        "ERRAWIN_IMAGE": s["x_err"],
        "ERRBWIN_IMAGE": s["y_err"],
        "ERRTHETAWIN_IMAGE": np.zeros(len(s)),
        "FLUX_AUTO": s["flux"],
        "FLUXERR_AUTO": s["flux"] / s["snr"],
        "FLAGS": np.zeros(len(s), np.int16),
    }
    write_ldac(Table(columns), header, path)
