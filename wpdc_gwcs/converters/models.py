"""ASDF converters of the models."""

from asdf_astropy.converters.transform.core import TransformConverterBase

__all__ = [
    "DetectorToSkyConverter",
    "DistortionCorrectionConverter",
    "InverseConverter",
    "LookupTableConverter",
    "PVPolynomialConverter",
    "TangentSkyConverter",
]


class PVPolynomialConverter(TransformConverterBase):
    """Converter of `~wpdc_gwcs.models.PVPolynomial`."""

    tags = ("asdf://wpdc-gwcs/tags/pv_polynomial-1.*",)
    types = ("wpdc_gwcs.models.PVPolynomial",)

    def to_yaml_tree_transform(self, model, tag, ctx):
        """Return the node of a model."""
        return {
            "degree": model.degree,
            "radial": model.radial,
            "coefficients": model.coefficients.tolist(),
        }

    def from_yaml_tree_transform(self, node, tag, ctx):
        """Return the model of a node."""
        from wpdc_gwcs.models import PVPolynomial

        return PVPolynomial.from_coefficients(
            node["coefficients"], node["degree"], node.get("radial", False)
        )


class LookupTableConverter(TransformConverterBase):
    """Converter of `~wpdc_gwcs.models.LookupTable`."""

    tags = ("asdf://wpdc-gwcs/tags/lookup_table-1.*",)
    types = ("wpdc_gwcs.models.LookupTable",)

    def to_yaml_tree_transform(self, model, tag, ctx):
        """Return the node of a model."""
        return {
            "x_grid": model.x_grid,
            "y_grid": model.y_grid,
            "dx": model.dx,
            "dy": model.dy,
            "method": model.method,
        }

    def from_yaml_tree_transform(self, node, tag, ctx):
        """Return the model of a node."""
        from wpdc_gwcs.models import LookupTable

        return LookupTable(
            node["x_grid"], node["y_grid"], node["dx"], node["dy"], method=node["method"]
        )


class TangentSkyConverter(TransformConverterBase):
    """Converter of `~wpdc_gwcs.models.TangentSky`."""

    tags = ("asdf://wpdc-gwcs/tags/tangent_sky-1.*",)
    types = ("wpdc_gwcs.models.TangentSky",)

    def to_yaml_tree_transform(self, model, tag, ctx):
        """Return the node of a model."""
        return {name: getattr(model, name).value.tolist() for name in ("crpix", "cd", "crval")}

    def from_yaml_tree_transform(self, node, tag, ctx):
        """Return the model of a node."""
        from wpdc_gwcs.models import TangentSky

        return TangentSky(node["crpix"], node["cd"], node["crval"])


class DistortionCorrectionConverter(TransformConverterBase):
    """Converter of `~wpdc_gwcs.models.DistortionCorrection`."""

    tags = ("asdf://wpdc-gwcs/tags/distortion_correction-1.*",)
    types = ("wpdc_gwcs.models.DistortionCorrection",)

    def to_yaml_tree_transform(self, model, tag, ctx):
        """Return the node of a model."""
        node = {
            "crpix": model.crpix.value.tolist(),
            "cd": model.cd.value.tolist(),
            "pv": model.pv,
        }
        if model.lookup_table is not None:
            node["lookup_table"] = model.lookup_table
        return node

    def from_yaml_tree_transform(self, node, tag, ctx):
        """Return the model of a node."""
        from wpdc_gwcs.models import DistortionCorrection

        return DistortionCorrection(node["crpix"], node["cd"], node["pv"], node.get("lookup_table"))


class DetectorToSkyConverter(TransformConverterBase):
    """Converter of `~wpdc_gwcs.models.DetectorToSky`."""

    tags = ("asdf://wpdc-gwcs/tags/detector_to_sky-1.*",)
    types = ("wpdc_gwcs.models.DetectorToSky",)

    def to_yaml_tree_transform(self, model, tag, ctx):
        """Return the node of a model."""
        return {"distortion": model.distortion, "sky": model.sky}

    def from_yaml_tree_transform(self, node, tag, ctx):
        """Return the model of a node."""
        from wpdc_gwcs.models import DetectorToSky

        return DetectorToSky(node["distortion"], node["sky"])


class InverseConverter(TransformConverterBase):
    """Converter of the inverses: they are stored as the model they invert."""

    tags = ("asdf://wpdc-gwcs/tags/inverse-1.*",)
    types = (
        "wpdc_gwcs.models.PVInverse",
        "wpdc_gwcs.models.DistortionInverse",
        "wpdc_gwcs.models.SkyTangent",
        "wpdc_gwcs.models.SkyToDetector",
    )

    def to_yaml_tree_transform(self, model, tag, ctx):
        """Return the node of a model."""
        return {"forward": model.inverse}

    def from_yaml_tree_transform(self, node, tag, ctx):
        """Return the model of a node."""
        return node["forward"].inverse
