"""ASDF entry points: schemas, manifest and the extension that ties them to the converters.

::

    tag --manifest--> schema
    tag <--converter--> class

asdf imports this module for every file it opens, so nothing here imports the models.
"""

from pathlib import Path

__all__ = ["extensions", "resource_mappings"]

_ROOT = "asdf://wpdc-gwcs"


def resource_mappings():
    """Return the mappings from URIs to schemas and manifests.

    Returns
    -------
    mappings : list of asdf.resource.DirectoryResourceMapping
        One for the schemas, one for the manifests.
    """
    from asdf.resource import DirectoryResourceMapping

    resources = Path(__file__).parent / "resources"
    return [
        DirectoryResourceMapping(resources / kind, f"{_ROOT}/{kind}/")
        for kind in ("schemas", "manifests")
    ]


def extensions():
    """Return the ASDF extensions, the newest first.

    Returns
    -------
    extensions : list of asdf.extension.ManifestExtension
        One for each released manifest.
    """
    from asdf.extension import ManifestExtension

    from wpdc_gwcs.converters import CONVERTERS

    return [
        ManifestExtension.from_uri(
            f"{_ROOT}/manifests/wpdc_gwcs-1.0.0",
            converters=[converter() for converter in CONVERTERS],
        )
    ]
