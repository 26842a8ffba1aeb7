"""ASDF converter of the WCS."""

from asdf.extension import Converter

__all__ = ["DetectorWCSConverter"]


class DetectorWCSConverter(Converter):
    """Converter of `~wpdc_gwcs.wcs.DetectorWCS`; the node is that of `gwcs.WCS`."""

    tags = ("asdf://wpdc-gwcs/tags/detector_wcs-1.*",)
    types = ("wpdc_gwcs.wcs.DetectorWCS",)

    def to_yaml_tree(self, wcs, tag, ctx):
        """Return the node of a WCS."""
        return {"name": wcs.name, "steps": wcs.pipeline, "pixel_shape": wcs.pixel_shape}

    def from_yaml_tree(self, node, tag, ctx):
        """Return the WCS of a node."""
        from wpdc_gwcs.wcs import DetectorWCS

        wcs = DetectorWCS(list(node["steps"]), name=node["name"])
        if node.get("pixel_shape") is not None:
            wcs.pixel_shape = node["pixel_shape"]
        return wcs
