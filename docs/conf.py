"""Configuration of the documentation."""

from importlib.metadata import version as _version

from sphinx_astropy.conf.v3 import *  # noqa: F403
from sphinx_astropy.conf.v3 import exclude_patterns, extensions

project = "wpdc_gwcs"
author = "The wpdc_gwcs developers"
copyright = author
release = _version("wpdc_gwcs")
version = ".".join(release.split(".")[:2])

exclude_patterns += ["_build"]

# Built without the network: names of other packages are shown, not linked.
extensions = [e for e in extensions if not e.endswith(("intersphinx", "intersphinx_toggle"))]
intersphinx_mapping = {}

automodapi_inheritance_diagram = False
automodapi_toctreedirnm = "reference/api"
numpydoc_show_class_members = False
numpydoc_xref_param_type = False

html_title = f"wpdc_gwcs {release}"
html_copy_source = False
htmlhelp_basename = "wpdc_gwcsdoc"

# Sphinx takes a class for an alias if it calls itself by another name, as ours does for astropy.
from wpdc_gwcs.wcs import DetectorWCS  # noqa: E402

DetectorWCS.__name__ = DetectorWCS.__qualname__
