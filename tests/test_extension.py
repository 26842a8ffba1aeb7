"""ASDF: converters, schemas and their examples, stored files of every released version."""

import io
import subprocess
import sys
from pathlib import Path

import asdf
import numpy as np
import pytest
import yaml
from asdf.exceptions import ValidationError
from numpy.testing import assert_allclose

from wpdc_gwcs.extension import extensions, resource_mappings
from wpdc_gwcs.models import (
    DetectorToSky,
    DistortionCorrection,
    DistortionInverse,
    LookupTable,
    PVInverse,
    PVPolynomial,
    SkyTangent,
    SkyToDetector,
    TangentSky,
)
from wpdc_gwcs.wcs import DetectorWCS, build_wcs, to_stock_wcs

DATA = Path(__file__).parent / "data" / "asdf"
MANIFESTS = ["asdf://wpdc-gwcs/manifests/wpdc_gwcs-1.0.0"]


def make_table(method="cubic"):
    x, y = np.linspace(-0.5, 63.5, 6), np.linspace(-0.5, 47.5, 5)
    gx, gy = np.meshgrid(x, y)
    return LookupTable(x, y, 0.1 * np.sin(gx / 7), 0.2 * np.cos(gy / 9), method=method)


def make_wcs():
    return build_wcs(
        crpix=(31.5, 23.5),
        cd=[[-2e-5, 1e-7], [0.0, 2e-5]],
        pv_cd=[[-2e-5, 0.0], [0.0, 2.01e-5]],
        crval=(359.999, 89.99),
        pv=PVPolynomial(pv1_4=5.0, pv2_10=-3e3),
        lookup_table=make_table(),
        image_shape=(48, 64),
    )


def write_and_read(tree, path):
    asdf.AsdfFile(tree).write_to(path)
    with asdf.open(path) as file:
        # Arrays must survive the file, so nothing is done before it is closed.
        return dict(file.tree)


def all_models():
    wcs = make_wcs()
    distortion, sky = (step.transform for step in wcs.pipeline[:-1])
    radial = PVPolynomial(5, radial=True, pv1_3=0.1, pv2_20=1 / 3, fixed={"pv1_0": True}, name="r")
    return {
        "pv": PVPolynomial(pv1_4=0.1),
        "radial": radial,
        "cubic": make_table(),
        "linear": make_table("linear"),
        "sky": sky,
        "distortion": distortion,
        "plain": DistortionCorrection((1, 2), np.eye(2)),
        "fused": DetectorToSky(distortion, sky),
        "pv_inverse": radial.inverse,
        "sky_inverse": sky.inverse,
        "distortion_inverse": distortion.inverse,
        "fused_inverse": DetectorToSky(distortion, sky).inverse,
    }


def test_models_round_trip(tmp_path, rng):
    models = all_models()
    found = write_and_read(models, tmp_path / "models.asdf")
    pixels, plane = rng.uniform(0, 40, (2, 30)), rng.uniform(-0.01, 0.01, (2, 30))
    for key, model in models.items():
        other = found[key]
        assert type(other) is type(model), key
        assert other.inputs == model.inputs
        assert other.outputs == model.outputs
        assert other.name == model.name
        points = plane if isinstance(model, (PVPolynomial, PVInverse)) else pixels
        if isinstance(model, (SkyTangent, SkyToDetector)):
            points = models["sky"](*pixels)
        assert_allclose(other(*points), model(*points), rtol=0, atol=0)
    assert found["radial"].degree == 5
    assert found["radial"].radial
    assert found["radial"].fixed["pv1_0"]
    assert_allclose(found["radial"].coefficients, models["radial"].coefficients, rtol=0, atol=0)


@pytest.mark.parametrize("method", ["cubic", "linear"])
def test_tables_round_trip_node_by_node(method, tmp_path):
    table = make_table(method)
    found = write_and_read({"table": table}, tmp_path / "table.asdf")["table"]
    for name in ("x_grid", "y_grid", "dx", "dy"):
        assert np.array_equal(getattr(found, name), getattr(table, name)), name
    assert found.method == method


def check_wcs(found, wcs):
    assert type(found) is type(wcs)
    assert found.pixel_shape == wcs.pixel_shape
    assert found.available_frames == wcs.available_frames
    assert found.pixel_bounds == wcs.pixel_bounds
    x, y = np.meshgrid(np.linspace(-0.5, 63.5, 9), np.linspace(-0.5, 47.5, 7))
    assert_allclose(found(x, y), wcs(x, y), rtol=0, atol=0)
    assert_allclose(found.invert(*wcs(x, y)), (x, y), rtol=0, atol=1e-8)
    assert np.isnan(found(-1, 5)[0])
    tables = [w.pipeline[0].transform.lookup_table for w in (found, wcs)]
    assert np.array_equal(tables[0].dx, tables[1].dx)
    assert np.array_equal(tables[0].dy, tables[1].dy)


def test_wcs_round_trip(tmp_path):
    wcs = make_wcs()
    wcs.name = "chip 7"
    found = write_and_read({"wcs": wcs}, tmp_path / "wcs.asdf")["wcs"]
    check_wcs(found, wcs)
    assert found.name == "chip 7"
    without = build_wcs(crpix=(1, 2), cd=np.eye(2), crval=(3, 4))
    found = write_and_read({"wcs": without}, tmp_path / "without.asdf")["wcs"]
    assert found.pixel_shape is None
    assert found.bounding_box is None
    assert found(1.0, 2.0) == without(1.0, 2.0)


def test_user_inverse_and_bounding_box_are_kept(tmp_path):
    table = make_table()
    table.inverse = TangentSky((0, 0), np.eye(2), (1, 2))
    table.bounding_box = ((0, 5), (1, 6))
    found = write_and_read({"table": table}, tmp_path / "table.asdf")["table"]
    assert isinstance(found.inverse, TangentSky)
    assert found.bounding_box.bounding_box() == ((0, 5), (1, 6))


@pytest.mark.parametrize("path", sorted(DATA.glob("detector_wcs-*.asdf")), ids=lambda p: p.name)
def test_stored_files_of_every_released_version_open(path):
    with asdf.open(path) as file:
        found = file["wcs"]
        expected = np.array(file["expected"])
        points = np.array(file["points"])
    assert isinstance(found, DetectorWCS)
    assert_allclose(found(*points), expected, rtol=0, atol=1e-12)
    # The models of the file are those of today's package.
    check_wcs(found, make_wcs())


def test_every_released_version_has_a_stored_file():
    versions = {uri.rpartition("-")[2] for uri in MANIFESTS}
    assert versions == {path.stem.rpartition("-")[2] for path in DATA.glob("detector_wcs-*.asdf")}


# --- schemas


def resources():
    return {uri: mapping[uri] for mapping in resource_mappings() for uri in mapping}


def schema_examples():
    for uri, content in resources().items():
        if "/schemas/" in uri:
            for description, _version, example in yaml.safe_load(content)["examples"]:
                yield pytest.param(example, id=f"{uri.rpartition('/')[2]}: {description}")


@pytest.mark.parametrize("example", list(schema_examples()))
def test_schema_examples_are_valid(example):
    content = (
        "#ASDF 1.0.0\n#ASDF_STANDARD 1.6.0\n%YAML 1.1\n%TAG ! tag:stsci.edu:asdf/\n"
        "--- !core/asdf-1.1.0\nexample:\n  " + example.replace("\n", "\n  ").rstrip() + "\n...\n"
    )

    with asdf.open(io.BytesIO(content.encode())) as file:
        model = file["example"]
        assert type(model).__module__.startswith("wpdc_gwcs.")
        # What was read can be written.
        asdf.AsdfFile({"example": model}).validate()


def test_every_schema_has_a_tag_a_converter_and_an_example():
    found = resources()
    manifest = yaml.safe_load(found[MANIFESTS[0]])
    schemas = {uri for uri in found if "/schemas/" in uri}
    assert {tag["schema_uri"] for tag in manifest["tags"]} == schemas
    extension = extensions()[0]
    tags = {tag.tag_uri for tag in extension.tags}
    assert tags == {tag["tag_uri"] for tag in manifest["tags"]}
    handled = {
        tag
        for converter in extension.converters
        for pattern in converter.tags
        for tag in tags
        if asdf.util.uri_match(pattern, tag)
    }
    assert handled == tags
    for uri in schemas:
        schema = yaml.safe_load(found[uri])
        assert schema["id"] == uri
        assert schema["examples"], uri
        asdf.schema.check_schema(asdf.schema.load_schema(uri, resolve_references=True))


def test_every_model_has_a_converter():
    paths = {path for converter in extensions()[0].converters for path in converter.types}
    classes = (
        *(PVPolynomial, PVInverse, LookupTable, TangentSky, SkyTangent),
        *(DistortionCorrection, DistortionInverse, DetectorToSky, SkyToDetector),
    )
    assert {f"wpdc_gwcs.models.{cls.__name__}" for cls in classes} | {
        "wpdc_gwcs.wcs.DetectorWCS"
    } == paths


@pytest.mark.parametrize(
    ("good", "bad"),
    [("degree: 3", "degree: 9"), ("degree: 3", "degree: three"), ("degree: 3", "order: 3")],
)
def test_schema_rejects(good, bad, tmp_path):
    path = tmp_path / "bad.asdf"
    asdf.AsdfFile({"pv": PVPolynomial()}).write_to(path)
    text = path.read_text()
    assert good in text
    path.write_text(text.replace(good, bad))
    with asdf.config_context() as config:
        config.validate_on_read = True
        with pytest.raises(ValidationError):
            asdf.open(path)


def test_table_with_bad_nodes_in_a_file(tmp_path):
    """A file that was tampered with says so; it is not half read."""
    path = tmp_path / "bad.asdf"
    table = make_table()
    asdf.AsdfFile({"table": table}).write_to(path, all_array_storage="inline")
    text = path.read_text()
    first = repr(float(table.x_grid[1]))
    assert first in text
    path.write_text(text.replace(first, "3.0"))
    with asdf.config_context() as config:
        if hasattr(config, "warn_on_failed_conversion"):
            config.warn_on_failed_conversion = False
        with pytest.raises(ValueError, match="x_grid must be increasing"), asdf.open(path) as file:
            _ = file["table"]


# --- without the package


BLOCKER = """
import sys, warnings
warnings.simplefilter("error")
class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] == "wpdc_gwcs":
            raise ModuleNotFoundError(name)
sys.meta_path.insert(0, Blocker())
# asdf uses the backport on Python 3.11.
import importlib.metadata
modules = [importlib.metadata]
try:
    import importlib_metadata
    modules.append(importlib_metadata)
except ModuleNotFoundError:
    pass
def without(discover):
    return lambda **kwargs: (
        d for d in discover(**kwargs) if d.metadata["Name"] not in ("wpdc_gwcs", "wpdc-gwcs")
    )
for module in modules:
    module.Distribution.discover = without(module.Distribution.discover)
import asdf, numpy as np
with asdf.open(sys.argv[1], lazy_load=False) as file:
    wcs, points = file["wcs"], np.array(file["points"])
assert type(wcs).__module__.startswith("gwcs"), type(wcs)
assert not any(name.startswith("wpdc_gwcs") for name in sys.modules)
np.save(sys.argv[2], [*wcs(*points), *wcs.invert(*wcs(*points), with_bounding_box=False)])
"""


def test_stock_wcs_opens_without_the_package(tmp_path, rng):
    wcs = make_wcs()
    points = rng.uniform(0, 47, (2, 40))
    path, out = tmp_path / "stock.asdf", tmp_path / "out.npy"
    asdf.AsdfFile({"wcs": to_stock_wcs(wcs), "points": points}).write_to(path)
    subprocess.run([sys.executable, "-c", BLOCKER, path, out], check=True, cwd=tmp_path)
    found = np.load(out)
    sky = wcs.pipeline[1].transform.inverse
    assert_allclose(sky(*found[:2]), sky(*wcs(*points)), rtol=0, atol=1e-7)
    assert_allclose(found[2:], points, rtol=0, atol=2e-4)


def test_extension_is_light():
    """asdf imports it for every file it opens."""
    code = (
        "import sys; import wpdc_gwcs.extension as e; e.resource_mappings(); e.extensions();"
        "heavy = [m for m in sys.modules if m.split('.')[0] in ('scipy', 'gwcs')"
        " or m.startswith(('astropy.modeling', 'wpdc_gwcs.models', 'wpdc_gwcs.wcs'))];"
        "assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
