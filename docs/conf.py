"""Configuration of the documentation."""

from functools import partial
from importlib.metadata import version as _version

from docutils.nodes import SkipNode, literal_block
from docutils.utils.math import MathError, latex2mathml
from sphinx.errors import ExtensionError
from sphinx_astropy.conf.v2 import *  # noqa: F403
from sphinx_astropy.conf.v2 import exclude_patterns, extensions

project = "wpdc_gwcs"
author = "The wpdc_gwcs developers"
copyright = author
release = _version("wpdc_gwcs")
version = ".".join(release.split(".")[:2])

exclude_patterns += ["_build"]

# Built and read without the network: names of other packages are shown, not linked, and formulas
# are written into the pages.
_ONLINE = ("intersphinx", "intersphinx_toggle", "mathjax")
extensions = [e for e in extensions if e.rsplit(".", 1)[-1] not in _ONLINE]
intersphinx_mapping = {}
html_math_renderer = "mathml"

automodapi_inheritance_diagram = False
automodapi_toctreedirnm = "reference/api"
# For the template of classes in _templates/autosummary_core.
automodsumm_properties_are_attributes = False
templates_path = ["_templates"]
numpydoc_show_class_members = False
numpydoc_xref_param_type = False

html_title = f"wpdc_gwcs {release}"
html_copy_source = False
html_static_path = ["_static"]
html_css_files = ["pages.css"]
# Pages without others below them need no navigation at their side.
html_sidebars = {"tutorial/index": [], "changelog": []}
html_theme_options = {
    "logo": {"text": "wpdc_gwcs"},
    "header_links_before_dropdown": 8,
    "navbar_persistent": ["search-button"],
    "navigation_depth": 2,
    "show_nav_level": 2,
    "show_toc_level": 2,
    "icon_links": [
        {
            "name": "Source",
            "url": "https://github.com/wpdc-gwcs/wpdc_gwcs",
            "icon": "fa-brands fa-github",
        }
    ],
    "footer_start": ["copyright"],
    "footer_end": [],
}
htmlhelp_basename = "wpdc_gwcsdoc"

# Sphinx takes a class for an alias if it calls itself by another name, as ours does for astropy.
from wpdc_gwcs.wcs import DetectorWCS  # noqa: E402

DetectorWCS.__name__ = DetectorWCS.__qualname__


def _write_math(translator, node, *, block):
    tex = node.astext()
    try:
        written = latex2mathml.tex2mathml(tex, as_block=block)
    except MathError as error:
        raise ExtensionError(f"{node.source}:{node.line}: {error}: {tex}") from error
    # An apostrophe is no prime.
    written = written.replace("<mo>'</mo>", '<mo lspace="0" rspace="0">\u2032</mo>')
    tag = "div" if block else "span"
    translator.body.append(f'<{tag} class="formula">{written}</{tag}>')
    raise SkipNode


def _leave_plain(app, doctree):
    """Show commands and diagrams without the colors of Python."""
    for node in doctree.findall(literal_block):
        if "language" not in node and not node.astext().startswith(">>>"):
            node["language"] = "text"


def setup(app):
    """Let browsers draw the formulas by themselves: MathML instead of a script from elsewhere."""
    app.connect("doctree-read", _leave_plain)
    inline, block = (partial(_write_math, block=b) for b in (False, True))
    app.add_html_math_renderer("mathml", (inline, None), (block, None))
