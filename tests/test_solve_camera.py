"""A whole camera at once: a poor detector among good ones, and colors."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from wpdc_gwcs.models import deproject, project
from wpdc_gwcs.solution import Calibration
from wpdc_gwcs.solve import Exposure, solve

SHAPE = (512, 512)
CENTER = np.array([255.5, 255.5])
SCALE = 1e-4
NOISE = 0.05
PLACES = {"a": (-300.0, 280.0), "b": (300.0, 300.0), "c": (-290.0, -300.0)}
TURNS = {"a": 0.0, "b": 0.1, "c": 180.0}  # deg
POINTINGS = [(0.01, 40.0), (359.99, 40.01), (0.0, 39.98)]
ROLLS = [0.0, 0.3, -0.2]


def turn(angle):
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    return np.array([[c, -s], [s, c]])


class Camera:
    """Three detectors behind known optics, one of them turned by 180 deg, in three exposures."""

    def __init__(self, rng, counts):
        self.frames = []
        self.cds = [SCALE * turn(r) @ np.diag([-1.0, 1.0]) for r in ROLLS]
        for e in range(3):
            for name, n in counts.items():
                x, y = rng.uniform(-0.5, 511.5, (2, n))
                ra, dec = self.sky(e, name, x, y)
                error = np.full(n, NOISE)
                crval, cd = self.start(e, name)
                self.frames.append(
                    Exposure(
                        f"{name}{e}", *(np.array([x, y]) + rng.normal(0, NOISE, (2, n))),
                        ra, dec, crval, cd, error, error, detector=name, exposure=e,
                    )
                )  # fmt: skip

    def focal(self, name, x, y):
        z = np.array([np.asarray(x) - CENTER[0], np.asarray(y) - CENTER[1]])
        p = np.tensordot(turn(TURNS[name]), z, axes=1)
        return p + np.array(PLACES[name]).reshape(2, *[1] * (p.ndim - 1))

    def plane(self, e, name, x, y):
        """Tangent plane: third order optics, 8 px at the rim of 800 px, and a keystone."""
        p = self.focal(name, x, y) / 800.0
        square = np.sum(p**2, axis=0)
        p = 800.0 * p + 8.0 * p * square + np.array([2.0 * p[0] * p[1], 2.0 * p[1] ** 2])
        return np.tensordot(self.cds[e], p, axes=1)

    def sky(self, e, name, x, y):
        return np.array(deproject(*self.plane(e, name, x, y), POINTINGS[e]))

    def start(self, e, name):
        """Linear WCS as matching leaves it: off by 1 px and a thousandth."""
        sky = self.sky(
            e, name, CENTER[0] + np.array([1.0, 2.0, 1.0]), CENTER[1] + np.array([0, 0, 1.0])
        )
        plane = np.array(project(*sky, sky[:, 0]))
        return sky[:, 0], np.stack([plane[:, 1], plane[:, 2]], axis=1) * 1.001

    def errors(self, frame, e):
        """Errors (2, n, n) of a calibration, px along the axes of the detector, and sigmas."""
        name = frame.solution.detector
        x, y = np.meshgrid(np.linspace(0, 511, 21), np.linspace(0, 511, 21))
        found = project(*frame.wcs(x, y), frame.crval)
        truth = project(*self.sky(e, name, x, y), frame.crval)
        error = np.tensordot(np.linalg.inv(frame.cd), np.subtract(found, truth), axes=1)
        return error, np.array(frame.uncertainty(x, y)[:2])


def frames_of(result, names):
    return [
        Calibration(
            fit.name, result.solutions[name], fit.crval, fit.cd, field=fit.field, sigma=fit.sigma,
            color_shift=fit.color_shift, reference_color=result.reference_color,
        )
        for fit, name in zip(result.exposures, names, strict=True)
    ]  # fmt: skip


@pytest.fixture(scope="module")
def poor():
    camera = Camera(np.random.default_rng(11), {"a": 150, "b": 6, "c": 150})
    return camera, solve(camera.frames, image_shape=SHAPE)


def test_poor_detector_is_right_among_good_ones(poor):
    camera, result = poor
    assert result.rejected == {}
    assert set(result.solutions) == {"a", "b", "c"}
    frames = frames_of(result, [f.detector for f in camera.frames])
    for k, frame in enumerate(frames):
        error, sigma = camera.errors(frame, camera.frames[k].exposure)
        pull = np.sqrt(np.mean((error / sigma) ** 2))
        rms = np.sqrt(np.mean(error**2))
        assert pull < 1.7, frame.frame
        # 18 stars of the poor one tell its place, twelve numbers with the exposures' own; the
        # optics, of 8 px, are those of the others.
        assert rms < (2 * NOISE if frame.solution.detector == "b" else 0.02), frame.frame


class OwnCamera(Camera):
    """Detectors with distortions of their own, 40 px at the corners, up to degree 7."""

    def focal(self, name, x, y):
        u, v = np.asarray(x) / CENTER[0] - 1.0, np.asarray(y) / CENTER[1] - 1.0
        strength = {"a": 1.0, "b": -0.8, "c": 0.6}[name]
        dx = 20 * u * (u**2 + v**2) + 8 * (u**5 * v**2 - u**6)
        dy = 20 * v * (u**2 + v**2) - 8 * (u**3 * v**4 - v**6)
        return super().focal(name, x + strength * dx, y + strength * dy)


def test_high_degrees_of_each_detector():
    """Up to degree 5, such detectors were all refused, as if their pairs were wrong."""
    camera = OwnCamera(np.random.default_rng(4), {"a": 60, "b": 60, "c": 60})
    result = solve(camera.frames, image_shape=SHAPE)
    assert result.rejected == {}
    for k, frame in enumerate(frames_of(result, [f.detector for f in camera.frames])):
        error, sigma = camera.errors(frame, camera.frames[k].exposure)
        assert np.sqrt(np.mean(error**2)) < 1.6 * NOISE
        assert np.sqrt(np.mean((error / sigma) ** 2)) < 1.5


def test_poor_detector_alone_is_far_worse(poor):
    camera, result = poor
    mine = [f for f in camera.frames if f.detector == "b"]
    alone = solve([replace(f, exposure=None) for f in mine], image_shape=SHAPE)

    def rms(frames):
        return np.sqrt(np.mean([camera.errors(f, e)[0] ** 2 for e, f in enumerate(frames)]))

    together = frames_of(result, [f.detector for f in camera.frames])
    together = [f for f in together if f.solution.detector == "b"]
    assert rms(frames_of(alone, "bbb")) > 3 * rms(together)


def test_detectors_have_their_own_solutions(poor):
    """The turned one has the optics of the others, seen the other way round."""
    _, result = poor
    scales = [np.sqrt(abs(np.linalg.det(s.cd))) for s in result.solutions.values()]
    # 8 px times 3 r^2 at the middle of the detectors, r = 0.5.
    assert_allclose(scales, SCALE, rtol=0.03)
    a, c = result.solutions["a"].cd, result.solutions["c"].cd
    assert np.sign(a[0, 0]) == -np.sign(c[0, 0])
    for name, solution in result.solutions.items():
        assert solution.detector == name
        # The table follows the shortest waves to a hundredth of a pixel.
        assert_allclose(solution.wcs(*solution.crpix), solution.crval, atol=0.01 * SCALE)


COLOR_SHIFT = np.array([0.06, -0.04])  # px / mag


@pytest.fixture(scope="module")
def colored():
    """Exposures in which blue stars stand elsewhere than red ones."""
    rng = np.random.default_rng(4)
    camera = Camera(rng, {"a": 400})
    frames = []
    for f in camera.frames:
        color = rng.gamma(4.0, 0.3, len(f.x))
        color[:20] = np.nan
        # Refraction moves the measured star, by nothing at a color of 1.
        x, y = np.array([f.x, f.y]) + COLOR_SHIFT[:, None] * np.nan_to_num(color - 1.0)
        frames.append(replace(f, x=x, y=y, color=color))
    return camera, frames, solve(frames, image_shape=SHAPE)


class TestColor:
    def test_wcs_is_for_the_median_color(self, colored):
        camera, frames, result = colored
        known = np.concatenate([f.color[20:] for f in frames])
        assert_allclose(result.reference_color, np.median(known))
        shift = COLOR_SHIFT * (result.reference_color - 1.0)
        for e, frame in enumerate(frames_of(result, "aaa")):
            # A star of that color at (x, y) is where one of color 1 is at (x, y) - shift.
            error, _ = camera.errors(frame, e)
            assert_allclose(error.mean((1, 2)), -shift, atol=3 * NOISE * np.sqrt(6 / 400))

    @pytest.mark.parametrize("color", [0.3, 2.5])
    def test_at_color_predicts_the_shift(self, colored, color):
        camera, _, result = colored
        for e, frame in enumerate(frames_of(result, "aaa")):
            other = frame.at_color(color)
            assert other.reference_color == color
            error = camera.errors(other, e)[0].mean((1, 2))
            # The slope is known to 0.05 / sqrt(400) / 0.6 per mag, the lateral color as well.
            atol = 4 * NOISE / np.sqrt(400) * (1 + abs(color - result.reference_color) / 0.6)
            assert_allclose(error, -COLOR_SHIFT * (color - 1.0), atol=atol)

    def test_colors_help(self, colored):
        """Without them their scatter, 0.6 mag of 0.07 px, is in the residuals."""
        _, frames, result = colored
        plain = solve([replace(f, color=None) for f in frames], image_shape=SHAPE)
        assert plain.reference_color is None
        assert all(f.color_shift is None for f in plain.exposures)

        def scatter(found):
            return np.mean(
                [np.hypot(np.std(f.dx[20:]), np.std(f.dy[20:])) for f in found.exposures]
            )

        assert scatter(result) < 1.06 * NOISE * np.sqrt(2) < scatter(plain)

    def test_too_few_colors_are_not_used(self, colored):
        _, frames, _ = colored
        sparse = [
            replace(f, color=np.where(np.arange(len(f.x)) < 150, f.color, np.nan)) for f in frames
        ]
        assert solve(sparse, image_shape=SHAPE).reference_color is None


class TestRich:
    """The same camera with 150 stars on every detector."""

    @pytest.fixture(scope="class")
    @staticmethod
    def camera():
        return Camera(np.random.default_rng(7), dict.fromkeys("abc", 150))

    def rms(self, camera, result):
        frames = frames_of(result, [f.detector for f in camera.frames])
        errors = [camera.errors(c, f.exposure)[0] for c, f in zip(frames, camera.frames)]
        used = [e for e, fit in zip(errors, result.exposures) if fit.reason is None]
        return np.sqrt(np.mean(np.square(used)))

    def test_stored_solutions(self, camera):
        """They leave places and attitudes to the new exposures, which 150 stars tell."""
        stored = solve(camera.frames, image_shape=SHAPE).solutions
        new = Camera(np.random.default_rng(8), dict.fromkeys("abc", 150))
        result = solve(new.frames, image_shape=SHAPE, solution=stored)
        assert result.solutions == stored
        assert self.rms(new, result) < 0.02

    def test_some_detectors_are_stored(self, camera):
        """The others are solved as ever."""
        stored = solve(camera.frames, image_shape=SHAPE).solutions
        result = solve(camera.frames, image_shape=SHAPE, solution={"a": stored["a"]})
        assert result.solutions["a"] is stored["a"]
        assert self.rms(camera, result) < 0.03

    def test_a_stored_solution_that_does_not_hold(self, camera):
        """Its frames are left out, for a reason that those of the other detectors would not get."""
        stored = solve(camera.frames, image_shape=SHAPE).solutions
        curved = stored["b"].pv.copy()
        curved.pv1_4 = curved.pv1_4 + 100.0
        changed = stored | {"b": replace(stored["b"], pv=curved)}
        result = solve(camera.frames, image_shape=SHAPE, solution=changed)
        assert set(result.rejected) == {"b0", "b1", "b2"}
        assert all("a stored solution that is not valid" in r for r in result.rejected.values())

    def test_wrong_pairs_of_one_frame(self, camera, rng):
        """It is left out, and the eight others are as good as ever."""
        frames, order = list(camera.frames), rng.permutation(150)
        frames[4] = replace(frames[4], ra=frames[4].ra[order], dec=frames[4].dec[order])
        result = solve(frames, image_shape=SHAPE)
        assert list(result.rejected) == ["b1"]
        assert "wrong pairs" in result.rejected["b1"]
        assert self.rms(camera, result) < 0.02

    def test_a_frame_without_usable_pairs(self, camera):
        frames = list(camera.frames)
        frames[4] = replace(frames[4], use=np.zeros(150, bool))
        result = solve(frames, image_shape=SHAPE)
        assert result.rejected == {"b1": "none of its pairs can be used"}
        assert self.rms(camera, result) < 0.02

    def test_detectors_missing_from_some_exposures(self, camera):
        some = [f for f in camera.frames if f.name not in ("b0", "c1", "c2")]
        result = solve(some, image_shape=SHAPE)
        frames = frames_of(result, [f.detector for f in some])
        errors = [camera.errors(c, f.exposure)[0] for c, f in zip(frames, some)]
        assert np.sqrt(np.mean(np.square(errors))) < 0.02

    def test_one_exposure(self, camera):
        """Places and distortion of three detectors from one exposure."""
        some = [f for f in camera.frames if f.exposure == 0]
        result = solve(some, image_shape=SHAPE)
        frames = frames_of(result, "abc")
        errors, sigmas = zip(*(camera.errors(c, 0) for c in frames))
        assert np.sqrt(np.mean(np.square(errors))) < 0.03
        assert 0.5 < np.sqrt(np.mean(np.divide(errors, sigmas) ** 2)) < 1.5
