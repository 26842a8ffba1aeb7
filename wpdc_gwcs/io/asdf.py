"""Calibrations and solutions as ASDF: a stock gwcs for everyone, and an exact plain tree.

::

    {"wcs": gwcs in stock models,
     "wpdc": {format_version, kind, ...}}

Layout of ``wpdc``, format version 1.2.0 (arrays are core ASDF arrays, all else plain YAML):

======================= ========================================================================
``format_version``      "1.2.0"
``kind``                "solution", "calibration" or "camera"
``content_sum``         SHA-256 over names and values of all the rest, see `content_sum`
``software``            name and version of the writer
``solution``            the instrument, see below
``frame``               of a calibration: name of the frame, and with it ``crval``, ``cd``,
                        ``field`` (a table like ``lookup_table``, or null), ``sigma``,
                        ``color_shift``, ``reference_color``, ``statistics``, ``settings``,
                        ``provenance``
======================= ========================================================================

``solution`` has ``detector``, ``image_shape`` (ny, nx), ``crpix`` (zero based), ``cd``, ``crval``,
``pv`` (``degree``, ``radial``, ``indices``, ``coefficients``), ``lookup_table`` (``method``,
``x_grid``, ``y_grid``, ``dx``, ``dy``) or null, ``table_sigma``, ``residual_map`` (solution files
only), ``statistics``, ``settings``, ``provenance``, ``valid_from``, ``valid_to``.  A camera has no
``wcs``; it has ``name``, ``detectors``, ``reference``, ``places``, ``matrices``, ``image_shapes``,
``cd``, ``learned``, ``files`` (detector to solution file beside it) and ``provenance``.  Matches
and sources are in separate tables.  Files of version 1.0.0 can be read, but without the
uncertainties of frames.  Files before 1.2.0 have no ``content_sum``.
"""

import dataclasses
import warnings
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path

import asdf
import numpy as np
from asdf.extension import Extension, TagDefinition
from astropy.modeling import CompoundModel

from wpdc_gwcs.camera import Camera
from wpdc_gwcs.exceptions import FileFormatError, InputError
from wpdc_gwcs.export import FORMAT_VERSION
from wpdc_gwcs.io.extensions import load_extensions
from wpdc_gwcs.io.files import READ_ERRORS, as_utf8, atomic_path, first_line
from wpdc_gwcs.io.integrity import check_size, check_version, content_sum
from wpdc_gwcs.lookup import ResidualMap
from wpdc_gwcs.models import LookupTable, PVPolynomial
from wpdc_gwcs.solution import Calibration, DistortionSolution

__all__ = [
    "read_asdf",
    "read_asdf_wcs",
    "read_entry",
    "sum_of",
    "write_asdf",
    "write_stock",
    "write_tree",
]

# Fields that have their own files, and fields that only the file of the detector has.
_NOT_STORED = {"matches", "sources"}
_NOT_IN_FRAMES = {"residual_map"}
_FIRST_WITH_SUM = (1, 2)
# Arrays up to this size are written as text, where they can be read: CRPIX, CD, a cubic.
_INLINE_VALUES = 20


def write_asdf(obj, path, *, overwrite=False):
    """Write a calibration or a solution.

    Parameters
    ----------
    obj : `~wpdc_gwcs.Calibration`, `~wpdc_gwcs.DistortionSolution` or `~wpdc_gwcs.Camera`
        Object to write; the solutions of a camera are not included, they have their own files.
    path : path-like
        File to write.
    overwrite : bool, optional
        Whether an existing file may be replaced.

    Raises
    ------
    InputError
        If a camera does not name the files of its solutions.
    """
    from wpdc_gwcs import __version__
    from wpdc_gwcs.wcs import to_stock_wcs

    tree = {"format_version": FORMAT_VERSION}
    software = {"name": "wpdc_gwcs", "version": __version__}
    if isinstance(obj, Camera):
        if set(obj.files) != set(obj.detectors):
            raise InputError(f"{path}: a camera must name the solution file of each detector")
        tree |= {"kind": "camera", "software": software, **_fields_of(obj, {"solutions"})}
        write_tree({"wpdc": _summed(tree)}, path, overwrite)
        return
    if isinstance(obj, Calibration):
        tree |= {"kind": "calibration", "software": software, **_fields_of(obj, _NOT_STORED)}
    else:
        tree |= {"kind": "solution", "software": software, "solution": _fields_of(obj, set())}
    # A residual map is mostly empty bins.
    compression = "zlib" if getattr(obj, "residual_map", None) is not None else None
    trees = {"wcs": to_stock_wcs(obj.wcs), "wpdc": _summed(tree)}
    write_tree(trees, path, overwrite, compression)


def write_stock(obj, path, *, overwrite=False):
    """Write the stock gwcs alone.

    Parameters
    ----------
    obj : `~wpdc_gwcs.Calibration` or `~wpdc_gwcs.DistortionSolution`
        What to write.
    path : path-like
        File to write.
    overwrite : bool, optional
        Whether an existing file may be replaced.

    Returns
    -------
    deviation : float or None
        Largest deviation from the exact WCS, px; `None` if the shape of the detector is unknown.
    """
    from wpdc_gwcs.export import deviation
    from wpdc_gwcs.wcs import to_stock_wcs

    wcs = to_stock_wcs(obj.wcs)
    write_tree({"wcs": wcs}, path, overwrite)
    shape = obj.solution.image_shape if isinstance(obj, Calibration) else obj.image_shape
    return None if shape is None else deviation(obj, wcs, n=101)


def sum_of(obj):
    """Compute the checksum of the content of a result.

    Parameters
    ----------
    obj : `~wpdc_gwcs.Calibration`, `~wpdc_gwcs.DistortionSolution` or `~wpdc_gwcs.Camera`
        The result.

    Returns
    -------
    sum : str
        See `wpdc_gwcs.io.integrity.content_sum`.
    """
    return content_sum(_fields_of(obj, _NOT_STORED))


def read_asdf(path):
    """Read a calibration or a solution.

    Parameters
    ----------
    path : path-like
        File that `write_asdf` wrote.

    Returns
    -------
    obj : `~wpdc_gwcs.Calibration`, `~wpdc_gwcs.DistortionSolution` or `~wpdc_gwcs.Camera`
        As written, with the fast WCS; without matches and sources.  A camera comes with the
        solutions in the files that it names.

    Raises
    ------
    FileFormatError
        If the file is damaged, of a newer format version or not of this kind.
    """
    tree = read_entry(path, "wpdc", whole=True)
    if not isinstance(tree, dict):
        raise FileFormatError(f"{path}: must have a 'wpdc' tree, has none: not a wpdc_gwcs file")
    version = check_version(tree.get("format_version"), path)
    _check_content(tree, version, path)
    kind = tree.get("kind")
    if kind not in ("solution", "calibration", "camera"):
        raise FileFormatError(
            f"{path}: kind must be 'solution', 'calibration' or 'camera', got {kind!r}"
        )
    try:
        if kind == "camera":
            return _read_camera(tree, path)
        solution = _object_of(DistortionSolution, _entry(tree, "solution", path), path)
        if kind == "solution":
            return solution
        return _object_of(Calibration, {**tree, "solution": solution}, path)
    except InputError:
        raise
    except READ_ERRORS as problem:
        raise FileFormatError(f"{path}: damaged 'wpdc' tree: {first_line(problem)}") from problem


def _read_camera(tree, path):
    camera = _object_of(Camera, {**tree, "solutions": {}}, path)
    solutions = {}
    if set(camera.files) != set(camera.detectors):
        raise FileFormatError(f"{path}: must have a file for each detector")
    for name, shape in zip(camera.detectors, camera.image_shapes):
        file = Path(path).parent / camera.files[name]
        if not file.is_file():
            raise FileFormatError(f"{path}: the file of detector {name!r} is missing: {file}")
        one = read_asdf(file)
        if not isinstance(one, DistortionSolution) or one.detector != name:
            raise FileFormatError(f"{path}: {file} is not the solution of detector {name!r}")
        if tuple(one.image_shape) != tuple(shape):
            raise FileFormatError(
                f"{path}: {file} is of shape (ny, nx) {tuple(one.image_shape)}, the camera's "
                f"detector {name!r} of {tuple(int(v) for v in shape)}"
            )
        solutions[name] = one
    return dataclasses.replace(camera, solutions=solutions)


def read_asdf_wcs(path):
    """Read the ``wcs`` of any ASDF file.

    Parameters
    ----------
    path : path-like
        ASDF file.

    Returns
    -------
    wcs : `~gwcs.wcs.WCS`
        As stored.

    Raises
    ------
    FileFormatError
        If the file is damaged or has no ``wcs``.
    """
    wcs = read_entry(path, "wcs")
    if not hasattr(wcs, "pixel_to_world_values"):
        raise FileFormatError(f"{path}: must have a 'wcs' that gwcs can open, has none")
    return wcs


def _summed(tree):
    return {**tree, "content_sum": content_sum(tree)}


def _check_content(tree, version, path):
    """Verify the checksum of the values; blocks have their own checksums."""
    given = tree.pop("content_sum", None)
    if given is None and version < _FIRST_WITH_SUM:
        return
    if given != content_sum(tree):
        raise FileFormatError(
            f"{path}: damaged ASDF file: the values do not agree with their 'content_sum'"
        )


class _Unchecked(Extension):
    """The tags of other extensions, without schema validation.

    asdf validates a tree when it is written.  This takes more than half of the time, and all parts
    of our trees with schemas have just been made by the converters of asdf and gwcs.
    """

    extension_uri = "asdf://wpdc_gwcs/extensions/unchecked-1.0.0"

    def __init__(self, uris):
        self._tags = [TagDefinition(uri) for uri in uris]

    @property
    def tags(self):
        return self._tags


@lru_cache(maxsize=1)
def _unchecked(extensions):
    return _Unchecked(dict.fromkeys(tag.tag_uri for one in extensions for tag in one.tags))


def _points_of(model):
    """Yield the nodes of all tables in a model, including its inverse."""
    if isinstance(model, CompoundModel):
        yield from _points_of(model.left)
        yield from _points_of(model.right)
    if model.has_user_inverse:
        yield from _points_of(model.inverse)
    yield from getattr(model, "points", ())


def write_tree(tree, path, overwrite, compression=None):
    """Write a tree atomically.

    Parameters
    ----------
    tree : dict
        Content of the file; the tables of a gwcs under ``wcs`` keep their nodes as text.
    path : path-like
        File to write.
    overwrite : bool
        Whether an existing file may be replaced.
    compression : str, optional
        Compression of arrays, by its name in asdf.
    """
    # The context copies the loaded extensions, so that they are searched only once.
    unchecked = _unchecked(load_extensions())
    with (
        atomic_path(path, overwrite=overwrite) as temporary,
        asdf.config_context() as config,
        # Open the file: asdf treats a path as a URL, in which '#', '?', ';' and '%' are special.
        open(temporary, "wb") as stream,
    ):
        # Stock tables may refer to arrays of a file that is closed by then.
        steps = tree["wcs"].pipeline[:-1] if "wcs" in tree else ()
        nodes = [points.size for step in steps for points in _points_of(step.transform)]
        config.array_inline_threshold = 1 + max([_INLINE_VALUES, *nodes])
        file = asdf.AsdfFile(tree, extensions=[unchecked])
        file.write_to(stream, all_array_compression=compression)


def read_entry(path, key, *, whole=False):
    """Read one entry of the tree; the others may need newer libraries.

    Parameters
    ----------
    path : path-like
        File to read.
    key : str
        Name of the entry.
    whole : bool, optional
        Whether to check that the file ends properly, too.

    Returns
    -------
    object
        Plain values, `None` if there is no such entry.

    Raises
    ------
    FileFormatError
        If the file is missing, damaged or cut short.
    """
    load_extensions()
    try:
        # Absolute, since a leading '~' is special to asdf, even if the file is open.
        with open(Path(path).absolute(), "rb") as stream, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if whole:
                _check_end(stream, path)
            check_size(stream, path)
            with asdf.open(
                stream, lazy_load=False, memmap=False, lazy_tree=True, validate_checksums=True
            ) as file:
                return _loaded(file.tree.get(key))
    except (asdf.exceptions.ValidationError, *READ_ERRORS) as problem:
        raise FileFormatError(
            f"{path}: damaged or truncated ASDF file: {first_line(problem)}"
        ) from problem


def _check_end(stream, path):
    """Raise an error if a file is cut short, even after the data."""
    stream.seek(max(0, stream.seek(0, 2) - 4096))
    if not stream.read().rstrip(b"\0\r\n ").endswith(b"..."):
        raise FileFormatError(f"{path}: truncated ASDF file: must end with '...', does not")
    stream.seek(0)


def _loaded(node):
    """Turn the lazy nodes of a file that is still open into plain values."""
    if isinstance(node, Mapping):
        return {key: _loaded(value) for key, value in node.items()}
    if isinstance(node, Sequence) and not isinstance(node, str):
        return [_loaded(value) for value in node]
    return np.array(node) if isinstance(node, asdf.tags.core.NDArrayType) else node


def _entry(tree, key, path):
    if key not in tree:
        raise FileFormatError(f"{path}: 'wpdc' tree must have {key!r}, has {', '.join(tree)}")
    return tree[key]


def _fields_of(obj, left_out):
    """Convert every field of a dataclass to a plain tree."""
    tree = {}
    for field in dataclasses.fields(obj):
        if field.name in left_out:
            continue
        value = getattr(obj, field.name)
        if isinstance(value, DistortionSolution):
            tree[field.name] = _fields_of(value, _NOT_IN_FRAMES)
        else:
            tree[field.name] = _plain(value, field.name)
    return tree


def _plain(value, where):
    """Convert a value to types of core ASDF."""
    if isinstance(value, np.generic):
        # Also NumPy scalars that are Python numbers, such as float64.
        return _plain(value.item(), where)
    if isinstance(value, str):
        return as_utf8(value)
    if value is None or isinstance(value, bool | int | float):
        return value
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        return np.array(value)
    if isinstance(value, PVPolynomial):
        return {
            "degree": value.degree,
            "radial": value.radial,
            "indices": [int(j) for j in value.term_indices],
            "coefficients": np.array(value.coefficients, float),
        }
    if isinstance(value, LookupTable):
        grids = {k: np.array(getattr(value, k), float) for k in ("x_grid", "y_grid", "dx", "dy")}
        return {"method": value.method, **grids}
    if isinstance(value, ResidualMap):
        return _plain(value.to_tree(), where)
    if isinstance(value, Path):
        return as_utf8(str(value))
    if dataclasses.is_dataclass(value):
        return _fields_of(value, set())
    if isinstance(value, dict):
        return {as_utf8(str(k)): _plain(v, f"{where}[{k!r}]") for k, v in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [_plain(v, f"{where}[{i}]") for i, v in enumerate(value)]
    raise TypeError(f"{where} must be made of plain values and arrays, got {type(value).__name__}")


def _object_of(cls, tree, path):
    """Build a dataclass from its tree; fields with defaults may be absent."""
    values = {}
    for field in dataclasses.fields(cls):
        required = (
            field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        )
        if field.name not in tree and not required:
            continue
        value = _entry(tree, field.name, path)
        if value is not None and field.name in _READERS:
            value = _READERS[field.name](value)
        values[field.name] = value
    return cls(**values)


def _read_pv(tree):
    pv = PVPolynomial.from_coefficients(
        np.array(tree["coefficients"], float), degree=tree["degree"], radial=tree["radial"]
    )
    if [int(j) for j in pv.term_indices] != list(tree["indices"]):
        raise ValueError(f"PV indices do not belong to degree {tree['degree']}: {tree['indices']}")
    return pv


def _read_table(tree):
    grids = (np.array(tree[k], float) for k in ("x_grid", "y_grid", "dx", "dy"))
    return LookupTable(*grids, method=tree["method"])


_READERS = {
    "pv": _read_pv,
    "lookup_table": _read_table,
    "field": _read_table,
    "residual_map": ResidualMap.from_tree,
    "detectors": tuple,
}
