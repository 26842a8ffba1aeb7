"""Places of detectors and pointings of exposures from the linear WCS of frames."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from wpdc_gwcs.models import deproject, project
from wpdc_gwcs.solve.exposure import Exposure
from wpdc_gwcs.solve.geometry import start_geometry
from wpdc_gwcs.solve.observations import gather

SCALE = 1e-4  # deg / px
SHAPE = (400, 600)
CRPIX = np.array([250.0, 180.0])
PLACES = {"a": (-400.0, 250.0), "b": (350.0, 260.0), "c": (-380.0, -300.0), "d": (390.0, -280.0)}
TURNS = {"a": 0.0, "b": 0.5, "c": 180.0, "d": -89.0}  # deg


def turn(angle, scale=1.0):
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    return scale * np.array([[c, -s], [s, c]])


class Camera:
    """Frames with the exact linear WCS of four detectors in some exposures."""

    def __init__(self, pointings, rolls, detectors="abcd"):
        self.pointings = np.array(pointings)
        self.cds = [SCALE * turn(r) @ np.diag([-1.0, 1.0]) for r in rolls]
        self.frames = []
        for e, names in enumerate([detectors] * len(rolls) if isinstance(detectors, str)
                                  else detectors):  # fmt: skip
            for name in names:
                self.frames.append(self.frame(e, name))
        shapes, crpix = dict.fromkeys(PLACES, SHAPE), dict.fromkeys(PLACES, CRPIX)
        self.observations = gather(self.frames, shapes, crpix)
        self.geometry = start_geometry(self.observations)

    def sky(self, e, name, x, y):
        offset = np.array([np.asarray(x) - CRPIX[0], np.asarray(y) - CRPIX[1]])
        focal = np.array(PLACES[name])[:, None] + turn(TURNS[name], 1.001) @ offset
        return np.array(deproject(*(self.cds[e] @ focal), self.pointings[e]))

    def frame(self, e, name):
        sky = self.sky(e, name, CRPIX[0] + np.array([0, 0.5, -0.5, 0, 0]),
                       CRPIX[1] + np.array([0, 0, 0, 0.5, -0.5]))  # fmt: skip
        crval = sky[:, 0]
        plane = np.array(project(*sky, crval))
        cd = np.stack([plane[:, 1] - plane[:, 2], plane[:, 3] - plane[:, 4]], axis=1)
        x, y = np.array([10.0, 500.0, 250.0]), np.array([20.0, 30.0, 390.0])
        return Exposure(
            f"{name}{e}", x, y, *self.sky(e, name, x, y), crval, cd, detector=name, exposure=e
        )

    def errors(self):
        """Largest distance of the sky of all detectors in all exposures from the truth, px."""
        o, worst = self.observations, []
        for f, frame in enumerate(self.frames):
            k, e = o.detector_of[f], o.exposure_of[f]
            x, y = o.detectors[k].grid(5)
            found = self.geometry.sky(e, self.geometry.focal(k, o.detectors[k], x, y))
            truth = self.sky(frame.exposure, frame.detector, x, y)
            plane = np.array(project(*found, frame.crval)) - project(*truth, frame.crval)
            worst.append(np.hypot(*plane).max() / SCALE)
        return max(worst)


@pytest.mark.parametrize("pointing", [(150.0, 2.0), (359.99, -30.0), (40.0, 89.97)])
def test_mosaic(pointing):
    """Rolls of the camera, RA 0 in the middle of a detector, the pole on another."""
    dither = np.array([[0.0, 0.0], [0.02, 0.01], [-0.01, 0.02]])
    dither[:, 0] /= np.cos(np.radians(pointing[1]))
    sky = (np.array(pointing) + dither) % [360, 1000]
    camera = Camera(sky, [0.0, 120.0, -77.0])
    # Tangent planes about other points differ by third order: 600 px of 1e-4 deg are 1e-3 rad.
    assert camera.errors() < 0.01
    assert 600 < camera.geometry.radius < 900


def test_places_are_those_of_the_camera():
    geometry = Camera([(10.0, 20.0), (10.02, 20.0)], [0.0, 30.0]).geometry
    # Up to the origin, scale and turn of the first detector, whose px are those of the plane.
    shift = np.array(list(PLACES.values()))
    inverse = np.linalg.inv(turn(TURNS["a"], 1.001))
    assert_allclose(geometry.matrix[0], np.eye(2), atol=1e-5)
    for k, name in enumerate("abcd"):
        relative = inverse @ (shift[k] - shift[0])
        assert_allclose(geometry.place[k] - geometry.place[0], relative, atol=0.01)
        assert_allclose(geometry.matrix[k], turn(TURNS[name]), atol=1e-5)


def test_exposures_that_share_only_some_detectors():
    camera = Camera(
        [(10.0, 20.0), (10.05, 20.0), (10.0, 20.05)], [0.0, 45.0, 10.0], ["ab", "bc", "cd"]
    )
    assert camera.errors() < 0.01


def test_exposures_that_share_nothing():
    camera = Camera([(10.0, 20.0), (200.0, -20.0)], [0.0, 45.0], ["ab", "cd"])
    assert camera.errors() < 0.01


def test_one_detector_is_its_own_focal_plane():
    camera = Camera([(10.0, 20.0), (10.05, 20.0)], [0.0, 45.0], "b")
    geometry = camera.geometry
    assert_allclose(geometry.place, 0)
    assert_allclose(geometry.matrix[0], np.eye(2))
    assert_allclose(geometry.pointing, [f.crval for f in camera.frames])
    assert_allclose(geometry.cd, [f.cd for f in camera.frames])
    assert camera.errors() < 1e-3
    corner = np.array([SHAPE[1] - 0.5, SHAPE[0] - 0.5]) - CRPIX
    assert_allclose(geometry.radius, np.hypot(*corner))


def test_reference_is_the_inverse_of_sky(rng):
    geometry = Camera([(0.0, 20.0), (10.02, 20.0)], [0.0, 30.0]).geometry
    focal = rng.uniform(-800, 800, (2, 30))
    for e in range(2):
        assert_allclose(geometry.reference(e, *geometry.sky(e, focal)), focal, atol=1e-7)


def test_moved():
    """A shift and a linear map of the focal plane become another pointing and CD."""
    geometry = Camera([(359.999, 60.0), (0.02, 60.0)], [0.0, 30.0]).geometry
    shift, matrix = np.array([3.0, -2.0]), np.array([[1.001, 2e-3], [-1e-3, 0.999]])
    pointing, cd = geometry.moved(0, shift, matrix)
    focal = np.array([[0.0, 300.0, -500.0], [0.0, 200.0, 400.0]])
    expected = geometry.sky(0, shift[:, None] + matrix @ focal)
    found = deproject(*(cd @ focal), pointing)
    plane = np.array(project(*found, pointing)) - project(*expected, pointing)
    # A shift of 3e-4 deg turns the plane by 1e-5 at this declination: 0.006 px at 600 px.
    assert np.hypot(*plane).max() / SCALE < 0.01
    assert_allclose(plane[:, 0], 0, atol=1e-12)
