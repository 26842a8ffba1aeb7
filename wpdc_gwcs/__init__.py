"""Wide-field distortion calibration: WPDC-2P as astropy models in a gwcs pipeline."""

from importlib import import_module

# Public name -> module that defines it.  Resolved on first use (PEP 562) to keep the import of the
# package light: asdf imports it for every file that it opens.
_PUBLIC = {
    "PVPolynomial": "models",
    "LookupTable": "models",
    "read_catalog": "catalogs",
    "GaiaArchive": "catalogs",
    "HatsCatalog": "catalogs",
    "Region": "catalogs",
    "detect_sources": "detection",
    "fit_centroids": "centroids",
    "build_epsf": "centroids",
    "match_sources": "matching",
    "WPDCFitter": "fitting",
    "RadialWeight": "fitting",
    "ResidualMap": "lookup",
    "build_lookup_table": "lookup",
    "build_wcs": "wcs",
    "to_stock_wcs": "wcs",
    "sky_map": "wcs",
    "fit_wcs": "conversion",
    "DistortionSolution": "solution",
    "Calibration": "solution",
    "Camera": "camera",
    "calibrate": "calibration",
    "Settings": "calibration",
    "evaluate": "evaluation",
    "detect_drift": "evaluation",
    "track_drift": "evaluation",
    "compare_weights": "evaluation",
    "read": "io",
    "read_frames": "io",
    "write": "io",
    "simulate": "simulation",
    "plot_before_after": "plotting",
    "plot_cdf": "plotting",
    "plot_cell_history": "plotting",
    "plot_centroids": "plotting",
    "plot_drift_history": "plotting",
    "plot_focal_plane": "plotting",
    "plot_lookup_table": "plotting",
    "plot_magnitude": "plotting",
    "plot_residual_arrows": "plotting",
    "plot_residual_maps": "plotting",
    "plot_residuals_vs_magnitude": "plotting",
    "plot_residuals_vs_position": "plotting",
    "plot_sky_offsets": "plotting",
    "plot_slices": "plotting",
    "plot_weights": "plotting",
    "write_report": "report",
}

__all__ = sorted([*_PUBLIC, "__version__"])


def __getattr__(name):
    if name == "__version__":
        from importlib.metadata import version

        value = version("wpdc_gwcs")
    elif name in _PUBLIC:
        value = getattr(import_module(f"wpdc_gwcs.{_PUBLIC[name]}"), name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__():
    return sorted({*globals(), *__all__})
