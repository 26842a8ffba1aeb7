"""Matching: recall, wrong pairs, refusals and time.

python benchmarks/matching.py                          all of it, briefly
python benchmarks/matching.py lab --seeds 1 2 3        cases of the lab (see below)
python benchmarks/matching.py random --n 1000          random solvable cases
python benchmarks/matching.py impossible --n 1000      cases that must be refused
python benchmarks/matching.py few-impossible --n 300   the same with 15 to 40 sources
python benchmarks/matching.py blind --n 100            mirrored, turned, wrong scale or pointing
python benchmarks/matching.py hard --n 100             random cases beyond that range
python benchmarks/matching.py times                    1e3 to 1e6 stars; memory; peers beside
python benchmarks/matching.py refusals                 time to refuse a small frame
python benchmarks/matching.py real                     CFHT/WIRCam frames with a wrong header

The lab (`field.py`, `judge.py`) is looked for in the folder of the environment variable
WPDC_GWCS_LAB or in ../shared/lab beside the repository, real frames in WPDC_GWCS_DATA or
../shared/data; what is absent is skipped.  astroalign, twirl and SCAMP run beside where installed.
Seconds are those of the processor as well as of the clock, since other work delays the clock.
"""

import argparse
import os
import resource
import shutil
import sys
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.table import Table
from astropy.time import Time
from astropy.wcs import WCS

from wpdc_gwcs.exceptions import MatchError
from wpdc_gwcs.matching import match_planes, match_sources

ROOT = Path(__file__).resolve().parents[1]
LAB_CASES = (
    "single",
    "single-sparse",
    "crowded",
    "cluster",
    "offset",
    "spurious",
    "deep-sources",
    "deep-reference",
    "moving",
)
ARCSEC = 1 / 0.074  # px


def locate(variable, name):
    folder = Path(os.environ.get(variable) or ROOT.parent / "shared" / name)
    return folder if folder.is_dir() else None


# Random fields


class Camera:
    """Smooth distortion of degree 2 to 6 about the center of the frame, exact and invertible."""

    def __init__(self, rng, shape, corner):
        self.shape = shape
        self.half = 0.5 * max(shape)
        self.powers = [(n - q, q) for n in range(2, 7) for q in range(n + 1)]
        falloff = [
            0.5 ** (p + q) * {2: 1, 3: 1, 4: 0.3, 5: 0.1, 6: 0.05}[p + q] for p, q in self.powers
        ]
        self.coefficients = rng.normal(size=(2, len(self.powers))) * falloff
        self.gain = 1.0
        u, v = np.meshgrid(np.linspace(0, shape[1] - 1, 33), np.linspace(0, shape[0] - 1, 33))
        self.gain = corner / np.hypot(*self.displacement(u.ravel(), v.ravel())).max()

    def displacement(self, x, y):
        u = (x - 0.5 * (self.shape[1] - 1)) / self.half
        v = (y - 0.5 * (self.shape[0] - 1)) / self.half
        # beyond the frame no polynomial means anything
        u, v = np.clip(u, -1.2, 1.2), np.clip(v, -1.2, 1.2)
        return self.gain * (self.coefficients @ np.array([u**p * v**q for p, q in self.powers]))

    def to_detector(self, x_ideal, y_ideal):
        x, y = x_ideal, y_ideal
        for _ in range(60):
            dx, dy = self.displacement(x, y)
            x, y = x_ideal - dx, y_ideal - dy
        return x, y


def draw_magnitudes(rng, n):
    low, high = 10 ** (0.25 * 17), 10 ** (0.25 * 25)
    return np.log10(low + rng.uniform(size=n) * (high - low)) / 0.25


def make_case(seed, *, max_stars=10_000):
    """One random field within the range that must be solved; who is who in ``true``."""
    rng = np.random.default_rng(seed)
    while True:
        shape = tuple(np.exp(rng.uniform(np.log(2048), np.log(9216), 2)).astype(int))
        density = np.exp(rng.uniform(np.log(2), np.log(2000))) * (0.074 / 60) ** 2  # px^-2
        if density * shape[0] * shape[1] < max_stars:
            break
    ny, nx = shape
    camera = Camera(rng, shape, rng.uniform(0, 200))
    margin = 900
    n = rng.poisson(density * (nx + 2 * margin) * (ny + 2 * margin))
    xi, yi = rng.uniform(-margin, nx + margin, n), rng.uniform(-margin, ny + margin, n)
    mag = draw_magnitudes(rng, n)
    depth = rng.choice(["same", "deep reference", "shallow reference"])
    x, y = camera.to_detector(xi, yi)
    seen = (
        (x > 0)
        & (x < nx - 1)
        & (y > 0)
        & (y < ny - 1)
        & (rng.uniform(size=n) > rng.uniform(0, 0.5))
    )
    seen &= mag < (22 if depth == "deep reference" else 25)
    true = np.flatnonzero(seen)
    sigma = np.interp(mag[true], [20, 25], [0.02, 0.07])
    extra = int(rng.uniform(0, 1) * len(true))
    xs = np.append(x[true] + rng.normal(size=len(true)) * sigma, rng.uniform(0, nx, extra))
    ys = np.append(y[true] + rng.normal(size=len(true)) * sigma, rng.uniform(0, ny, extra))
    source_mag = np.append(mag[true], rng.uniform(21, 25, extra))
    true = np.append(true, np.full(extra, -1))
    order = rng.permutation(len(xs))
    # the header's error moves the reference
    angle, scale = np.deg2rad(rng.uniform(-1, 1)), 1 + rng.uniform(-0.01, 0.01)
    shift, direction = 30 * ARCSEC * np.sqrt(rng.uniform()), rng.uniform(0, 2 * np.pi)
    c, s = scale * np.cos(angle), scale * np.sin(angle)
    u, v = xi - nx / 2, yi - ny / 2
    xr = nx / 2 + c * u - s * v + shift * np.cos(direction)
    yr = ny / 2 + s * u + c * v + shift * np.sin(direction)
    if depth == "shallow reference":
        kept = np.flatnonzero(mag < 22)
        new = np.full(n + 1, -1)
        new[kept] = np.arange(len(kept))
        xr, yr, mag, true = xr[kept], yr[kept], mag[kept], new[true]
    case = {
        "xs": xs[order],
        "ys": ys[order],
        "xr": xr,
        "yr": yr,
        "image_shape": shape,
        "true": true[order],
        "about": f"seed {seed} {nx}x{ny} {density * (60 / 0.074) ** 2:.0f}/arcmin2 {depth}",
    }
    if rng.uniform() < 0.7:
        case |= {"flux": 10 ** (-0.4 * source_mag[order]), "mag": mag}
    return case, rng


def run_case(case, **options):
    """Processor time, pairs and diagnostics of a case; pairs are None where it was refused."""
    options |= {k: case[k] for k in ("flux", "mag", "x_err", "y_err") if k in case}
    planes = [case[k] for k in ("xs", "ys", "xr", "yr")]
    began = time.process_time()
    try:
        i, j, diagnostics = match_planes(*planes, image_shape=case["image_shape"], **options)
    except MatchError as error:
        return time.process_time() - began, None, error
    return time.process_time() - began, (i, j), diagnostics


def is_wrong(false, n_pairs):
    """Whether so large a share of the pairs is false that they are another solution.

    One pair by chance is 3 % of 30, and no more than that.
    """
    return false * n_pairs > max(1.5, 0.02 * n_pairs)


def score(case, pairs):
    i, j = pairs
    right = case["true"][i] == j
    return right.sum() / max(1, (case["true"] >= 0).sum()), 1 - right.mean()


def make_hard_case(seed):
    """A case at or beyond the edge of what must be solved: everything goes wrong at once."""
    kinds = ("large and sparse", "half lost", "clusters", "steep", "noisy")
    kind = kinds[seed % len(kinds)]
    rng = np.random.default_rng([seed, 1])
    nx, ny = (9216, 9216) if kind == "large and sparse" else rng.integers(2048, 9216, 2)
    per_arcmin = 2.0 if kind == "large and sparse" else np.exp(rng.uniform(np.log(5), np.log(300)))
    density = min(per_arcmin * (0.074 / 60) ** 2, 8000 / (nx * ny))
    camera = Camera(rng, (ny, nx), 200.0 if kind != "noisy" else rng.uniform(0, 200))
    margin = 900
    n = rng.poisson(density * (nx + 2 * margin) * (ny + 2 * margin))
    size = np.array([nx, ny]) + 2 * margin
    points = rng.uniform(size=(n, 2)) * size - margin
    if kind == "clusters":
        # two of three stars stand in a few clumps
        centers = rng.uniform(size=(4, 2)) * [nx, ny]
        clump = rng.uniform(size=n) < 0.67
        width = rng.uniform(100, 500, 4)[pick := rng.integers(4, size=n)]
        points[clump] = (centers[pick] + rng.normal(size=(n, 2)) * width[:, None])[clump]
    mag = draw_magnitudes(rng, n)
    x, y = camera.to_detector(*points.T)
    lost = 0.5 if kind in ("half lost", "large and sparse") else 0.2
    seen = (x > 0) & (x < nx - 1) & (y > 0) & (y < ny - 1) & (rng.uniform(size=n) > lost)
    true = np.flatnonzero(seen)
    sigma = np.interp(mag[true], [20, 25], [0.02, 0.07]) * (10 if kind == "noisy" else 1)
    extra = len(true) if kind in ("half lost", "steep") else len(true) // 4
    xs, ys = (
        np.append(c[true] + rng.normal(size=len(true)) * sigma, rng.uniform(0, side, extra))
        for c, side in ((x, nx), (y, ny))
    )
    angle, scale = np.deg2rad(rng.choice([-1, 1])), 1 + rng.choice([-0.01, 0.01])
    direction = rng.uniform(0, 2 * np.pi)
    c, s = scale * np.cos(angle), scale * np.sin(angle)
    u, v = points[:, 0] - nx / 2, points[:, 1] - ny / 2
    xr = nx / 2 + c * u - s * v + 30 * ARCSEC * np.cos(direction)
    yr = ny / 2 + s * u + c * v + 30 * ARCSEC * np.sin(direction)
    kept = np.arange(n)
    if kind == "half lost":
        kept = np.flatnonzero(mag < 22)  # 3 mag shallower
    new = np.full(n + 1, -1)
    new[kept] = np.arange(len(kept))
    case = {
        "xs": xs, "ys": ys, "xr": xr[kept], "yr": yr[kept], "image_shape": (ny, nx),
        "true": new[np.append(true, np.full(extra, -1))],
        "about": f"seed {seed} {kind}, {nx}x{ny} {density * (60 / 0.074) ** 2:.0f}/arcmin2",
    }  # fmt: skip
    if rng.uniform() < 0.5:
        flux = 10 ** (-0.4 * np.append(mag[true], rng.uniform(21, 25, extra)))
        case |= {"flux": flux, "mag": mag[kept]}
    return case, rng


def report_random(n, first, max_stars, *, make=make_case, name="random"):
    solvable = solved = few = wrong = 0
    lowest, seconds = [], []
    for seed in range(first, first + n):
        case, _ = make(seed, max_stars=max_stars) if make is make_case else make(seed)
        common = int((case["true"] >= 0).sum())
        elapsed, pairs, result = run_case(case)
        seconds.append(elapsed)
        solvable += common >= 30
        if pairs is None:
            few += common < 30
            if common >= 30:
                print(f"  not solved: {case['about']}, {common} common: {result}")
            continue
        recall, false = score(case, pairs)
        solved += common >= 30
        lowest.append(recall)
        if is_wrong(false, len(pairs[0])) or recall < 0.5:
            wrong += 1
            print(
                f"  wrong: {case['about']}, {common} common, recall {recall:.3f} false {false:.3f}"
            )
    print(
        f"{name}: {n} cases, {solvable} with >= 30 common stars, {solved} of them solved, "
        f"{few} refused with fewer; silently wrong {wrong}; "
        f"recall: median {np.median(lowest):.4f}, 1 % {np.quantile(lowest, 0.01):.3f}; "
        f"{np.mean(seconds):.2f} s each (processor), longest {np.max(seconds):.1f}"
    )


def spoil(case, rng, kind):
    """Turn a case into one that has no answer."""
    case = dict(case)
    nx = case["image_shape"][1]
    if kind == "shuffled sources":
        case["ys"] = rng.permutation(case["ys"])
    elif kind == "shuffled reference":
        case["xr"] = rng.permutation(case["xr"])
    elif kind == "another field":
        # the same stars seen in a mirror and turned by an odd angle
        angle = rng.uniform(0.5, 2.5)
        u, v = case["xr"] - nx / 2, case["yr"] - nx / 2
        case["xr"] = nx / 2 - np.cos(angle) * u + np.sin(angle) * v
        case["yr"] = nx / 2 + np.sin(angle) * u + np.cos(angle) * v
    else:
        rows = rng.choice(len(case["xs"]), min(5, len(case["xs"])), replace=False)
        case |= {k: case[k][rows] for k in ("xs", "ys", "flux", "true") if k in case}
    return case


def report_impossible(n, first, max_stars):
    kinds = ("shuffled sources", "shuffled reference", "another field", "five stars")
    accepted, seconds = 0, []
    for seed in range(first, first + n):
        case, rng = make_case(seed, max_stars=max_stars)
        kind = kinds[seed % len(kinds)]
        elapsed, pairs, result = run_case(spoil(case, rng, kind))
        seconds.append(elapsed)
        if pairs is not None:
            accepted += 1
            print(f"  accepted: {kind}, {case['about']}: {result.to_dict()}")
    print(
        f"impossible: {n} cases, {n - accepted} refused; "
        f"{np.mean(seconds):.2f} s each (processor), longest {np.max(seconds):.1f}"
    )


def spoil_few(seed):
    """Few-star frame of `few_stars.py` whose sources have nothing to do with its catalog."""
    from few_stars import LAYOUTS, Field

    rng = np.random.default_rng([seed, 2])
    # a fifth as many are spurious: 15 to 40 sources
    stars = int(rng.integers(13, 34))
    layout = "all" if rng.uniform() < 0.5 else str(rng.choice(LAYOUTS))
    field = Field(seed, stars, layout, errors=rng.uniform() < 0.7)
    kind = ("new places", "mirror", "half a turn", "clumps")[seed // 16 % 4]
    sources, catalog = field.sources, field.catalog
    size = np.array(field.shape[::-1]) - 1
    x, y = np.array(sources["x"]), np.array(sources["y"])
    if kind == "new places":
        x, y = field._draw_places(rng, len(x))
    elif kind == "mirror":
        x = size[0] - x
    elif kind == "half a turn":
        x, y = size[0] - x, size[1] - y
    else:
        # half of either list in the same three clumps, as of clusters, star by star elsewhere
        centers, width = rng.uniform(0.2, 0.8, (3, 2)) * size, 0.05 * size.min()
        for of_catalog in (False, True):
            n = len(catalog if of_catalog else sources)
            clump = rng.uniform(size=n) < 0.5
            place = centers[rng.integers(3, size=n)] + width * rng.normal(size=(n, 2))
            place = np.clip(place, 0, size)[clump]
            if of_catalog:
                catalog["ra"][clump], catalog["dec"][clump] = field.sky(*place.T)
            else:
                x, y = field._draw_places(rng, n)
                x[clump], y[clump] = place.T
    sources["x"], sources["y"] = x, y
    if rng.uniform() < 0.2:
        del catalog["phot_g_mean_mag"]
    about = f"seed {seed} {kind}, {stars} stars, {layout}, {field.kind.__name__} {field.shape}"
    return field, sources, catalog, about


def report_few_impossible(n, first):
    for blind in (False, True):
        accepted, seconds = 0, []
        for seed in range(first, first + n):
            field, sources, catalog, about = spoil_few(seed)
            if blind and ("mirror" in about or "half a turn" in about):
                # A blind search finds these.
                continue
            shape = field.shape
            began = time.process_time()
            try:
                _, found = match_sources(
                    sources, catalog, field.header, image_shape=shape, blind=blind
                )
            except MatchError:
                continue
            finally:
                seconds.append(time.process_time() - began)
            accepted += 1
            print(f"  accepted: {about}: {found.to_dict()}")
        print(
            f"few-impossible{' (blind)' if blind else ''}: {len(seconds)} cases, "
            f"{len(seconds) - accepted} refused; "
            f"{np.mean(seconds):.2f} s each (processor), longest {np.max(seconds):.1f}"
        )


def report_refusals(n):
    """Sources and stars that have nothing to do with each other."""
    print("   frame  sources  reference  brightness  blind  seconds (processor): median  longest")
    for side, count in ((2048, 500), (2048, 2000), (9216, 500), (9216, 10_000)):
        for bright in (True, False):
            for blind in (False, True):
                seconds = []
                for seed in range(n):
                    rng = np.random.default_rng([seed, count, side])
                    m = int(count * ((side + 1200) / side) ** 2)
                    case = {
                        "xs": rng.uniform(0, side, count), "ys": rng.uniform(0, side, count),
                        "xr": rng.uniform(-600, side + 600, m),
                        "yr": rng.uniform(-600, side + 600, m),
                        "image_shape": (side, side),
                    }  # fmt: skip
                    if bright:
                        flux = 10 ** (-0.4 * draw_magnitudes(rng, count))
                        case |= {"flux": flux, "mag": draw_magnitudes(rng, m)}
                    elapsed, pairs, _ = run_case(case, blind=blind)
                    seconds.append(elapsed)
                    if pairs is not None:
                        print(f"  accepted: seed {seed}")
                print(
                    f"{side:8d} {count:8d} {m:10d}  {'yes' if bright else 'no':10s}  "
                    f"{'yes' if blind else 'no':5s} {np.median(seconds):28.2f} {max(seconds):8.2f}"
                )


def report_blind(n, first, max_stars):
    kinds = (
        "mirrored", "90 deg", "180 deg", "270 deg mirrored", "scale 5 %", "1/4 frame", "any angle",
        "any angle mirrored",
    )  # fmt: skip
    refused, solved, wrong, seconds = 0, 0, 0, []
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    flip = np.diag([-1.0, 1.0])
    seed, done = first, 0
    while done < n:
        case, rng = make_case(seed, max_stars=max_stars)
        seed += 1
        if (case["true"] >= 0).sum() < 40:
            continue
        kind = kinds[done % len(kinds)]
        done += 1
        angle = rng.uniform(0, 2 * np.pi)
        c, s = np.cos(angle), np.sin(angle)
        matrix = {
            "any angle": np.array([[c, -s], [s, c]]),
            "any angle mirrored": np.array([[c, -s], [s, c]]) @ flip,
            "mirrored": flip,
            "90 deg": turn,
            "180 deg": turn @ turn,
            "270 deg mirrored": turn.T @ flip,
            "scale 5 %": np.eye(2) * rng.choice([0.955, 1.045]),
        }.get(kind, np.eye(2))
        center = 0.5 * (np.array(case["image_shape"][::-1]) - 1)
        points = (np.column_stack([case["xr"], case["yr"]]) - center) @ matrix.T + center
        if kind == "1/4 frame":
            # on top of the pointing error that every case has
            length = max(0.25 * max(case["image_shape"]) - 30 * ARCSEC, 0)
            points += length * np.array([c, s])
        case |= {"xr": points[:, 0], "yr": points[:, 1]}
        refused += run_case(case)[1] is None
        elapsed, pairs, result = run_case(case, blind=True)
        seconds.append(elapsed)
        if pairs is None:
            print(f"  not solved: {kind}, {case['about']}: {result}")
            continue
        _, false = score(case, pairs)
        solved += 1
        wrong += is_wrong(false, len(pairs[0]))
    print(
        f"blind: {n} cases, {refused} refused without, {solved} solved with --blind, "
        f"{wrong} silently wrong; "
        f"{np.mean(seconds):.2f} s each (processor), longest {np.max(seconds):.1f}"
    )


# The lab


def lab_case(judge, field, name, seed):
    options = dict(judge.CASES[name])
    ref_gmax = options.pop("ref_gmax", None)
    reference, exposures = field.exposures(seed=seed, **options)
    if ref_gmax:
        reference = reference[np.asarray(reference["phot_g_mean_mag"]) < ref_gmax]
    return reference, exposures


def report_lab(names, seeds, *, magnitudes=True):
    folder = locate("WPDC_GWCS_LAB", "lab")
    if folder is None:
        print("lab: not found, skipped")
        return
    sys.path.insert(0, str(folder))
    import field
    import judge

    print(f"{'case':15s} frames solved wrong recall(min) false(max)   sources reference  s(max)")
    for name in names:
        rows, frames, wrong = [], 0, 0
        for seed in seeds:
            reference, exposures = lab_case(judge, field, name, seed)
            ids = np.asarray(reference["source_id"])
            for truth, header, found in exposures:
                frames += 1
                began = time.perf_counter()
                catalog = (
                    reference
                    if magnitudes
                    else reference["ra", "dec", "pmra", "pmdec", "ref_epoch"]
                )
                try:
                    matches, diagnostics = match_sources(
                        found,
                        catalog,
                        WCS(header),
                        image_shape=(truth.ny, truth.nx),
                        epoch=found.meta["epoch"],
                    )
                except MatchError as error:
                    print(f"  {name} seed {seed}: {error}")
                    continue
                true = np.asarray(found["true_id"])
                right = true[matches["source_index"]] == ids[matches["catalog_index"]]
                false = 1 - right.mean()
                wrong += is_wrong(false, len(matches))
                rows.append(
                    (
                        right.sum() / np.isin(true, ids).sum(),
                        false,
                        len(found),
                        diagnostics.n_reference,
                        sum(diagnostics.timings.values()),
                        time.perf_counter() - began,
                    )
                )
        if rows:
            r = np.array(rows)
            print(
                f"{name:15s} {frames:6d} {len(rows):6d} {wrong:5d} "
                f"{r[:, 0].min():11.4f} {r[:, 1].max():10.5f} "
                f"{r[:, 2].mean():9.0f} {r[:, 3].mean():9.0f} {r[:, 4].max():7.2f}"
            )


def report_scamp():
    """Time and error of SCAMP and of this package on one field of 8,500 stars."""
    folder = locate("WPDC_GWCS_LAB", "lab")
    if folder is None or not shutil.which("scamp"):
        print("SCAMP: it or the lab is not installed, skipped")
        return
    sys.path.insert(0, str(folder))
    import field
    import judge
    import scamp

    reference, exposures = lab_case(judge, field, "single", 1)
    truth, header, found = exposures[0]
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        scamp.write_sources(folder / "e.cat", truth, found, header)
        scamp.write_reference(folder / "ref.cat", reference)
        for degree in (3, 5):
            seconds, solved, _ = scamp.run(
                folder, ["e.cat"], "ref.cat", crossid=16.0, degree=degree
            )
            error = judge.grid_error(lambda x, y: solved[0].all_pix2world(x, y, 0), truth)  # noqa: B023
            print(
                f"SCAMP degree {degree}, case single, {len(found)} sources: {seconds:.1f} s, "
                f"no complaint, {np.sqrt((error**2).mean()):.2f} px rms off the truth"
            )
    began, busy = time.perf_counter(), time.process_time()
    matches, diagnostics = match_sources(
        found, reference, WCS(header), image_shape=(truth.ny, truth.nx), epoch=found.meta["epoch"]
    )
    seconds, busy = time.perf_counter() - began, time.process_time() - busy
    ids = np.asarray(reference["source_id"])
    right = np.asarray(found["true_id"])[matches["source_index"]] == ids[matches["catalog_index"]]
    print(
        f"this package, the same: {seconds:.2f} s ({busy:.2f} s processor), {len(matches)} pairs, "
        f"{np.count_nonzero(~right)} wrong, scatter {diagnostics.scatter:.3f} px"
    )


# Times


def report_times(numbers):
    print(
        "     stars  reference  brightness  seconds  processor  recall   false    GB   peers: "
        "seconds, right control points"
    )
    for n in numbers:
        for bright in (True, False):
            rng = np.random.default_rng(n)
            shape = (9232, 9216)
            camera = Camera(rng, shape, 200.0)
            n_ref = int(1.2 * n)
            xi, yi = rng.uniform(-300, 9516, (2, n_ref))
            mag = draw_magnitudes(rng, n_ref)
            x, y = camera.to_detector(xi, yi)
            inside = (x > 0) & (x < shape[1] - 1) & (y > 0) & (y < shape[0] - 1)
            true = np.flatnonzero(inside & (rng.uniform(size=n_ref) > 0.05))[: int(0.9 * n)]
            sigma = np.interp(mag[true], [20, 25], [0.02, 0.07])
            extra = n - len(true)
            case = {
                "xs": np.append(
                    x[true] + rng.normal(size=len(true)) * sigma, rng.uniform(0, shape[1], extra)
                ),
                "ys": np.append(
                    y[true] + rng.normal(size=len(true)) * sigma, rng.uniform(0, shape[0], extra)
                ),
                "xr": xi + 80,
                "yr": yi - 60,
                "image_shape": shape,
                "true": np.append(true, np.full(extra, -1)),
            }
            if bright:
                flux = 10 ** (-0.4 * np.append(mag[true], rng.uniform(21, 25, extra)))
                case |= {"flux": flux, "mag": mag}
            began = time.perf_counter()
            busy, pairs, result = run_case(case)
            seconds = time.perf_counter() - began
            memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
            recall, false = score(case, pairs) if pairs else (0.0, 0.0)
            peer = ""
            if bright and n <= 10_000:
                peer = f"astroalign {run_astroalign(case)}; twirl {run_twirl(case)}"
            print(
                f"{n:10d} {n_ref:10d}  {'yes' if bright else 'no':10s} {seconds:8.2f} {busy:10.2f} "
                f"{recall:7.4f} {false:8.6f} "
                f"{memory:5.2f}   {peer}"
            )
            if not pairs:
                print(f"  {result}")


def run_astroalign(case):
    """Similarity from asterisms of bright stars: how many of its control points are right."""
    try:
        import astroalign
    except ImportError:
        return "not installed"
    bright_s, bright_r = np.argsort(-case["flux"])[:200], np.argsort(case["mag"])[:300]
    points = [
        np.column_stack([case[x], case[y]])[rows]
        for x, y, rows in (("xs", "ys", bright_s), ("xr", "yr", bright_r))
    ]
    began = time.perf_counter()
    try:
        _, (a, b) = astroalign.find_transform(*points)
    except (astroalign.MaxIterError, TypeError, ValueError):
        return f"{time.perf_counter() - began:.2f} s, failed"
    seconds = time.perf_counter() - began
    i = bright_s[[int(np.argmin(np.hypot(*(points[0] - p).T))) for p in a]]
    j = bright_r[[int(np.argmin(np.hypot(*(points[1] - p).T))) for p in b]]
    return f"{seconds:.2f} s, {(case['true'][i] == j).sum()} of {len(i)}"


def run_twirl(case):
    """Affine transformation from asterisms of bright stars: the pairs it brings within 20 px."""
    try:
        from twirl.match import find_transform
    except ImportError:
        return "not installed"
    bright_s, bright_r = np.argsort(-case["flux"])[:15], np.argsort(case["mag"])[:25]
    points = [
        np.column_stack([case[x], case[y]])[rows]
        for x, y, rows in (("xs", "ys", bright_s), ("xr", "yr", bright_r))
    ]
    began = time.perf_counter()
    try:
        found = find_transform(*points, tolerance=20)
    except (TypeError, ValueError, np.linalg.LinAlgError):
        return f"{time.perf_counter() - began:.2f} s, failed"
    seconds = time.perf_counter() - began
    if found is None:
        return f"{seconds:.2f} s, none"
    mapped = np.column_stack([points[0], np.ones(len(points[0]))]) @ np.asarray(found).T
    gap = np.hypot(*(mapped[:, None, :2] - points[1][None]).transpose(2, 0, 1))
    i, near = np.flatnonzero(gap.min(1) < 20), gap.argmin(1)
    right = case["true"][bright_s[i]] == bright_r[near[i]]
    return f"{seconds:.2f} s, {right.sum()} of {len(i)}"


# Real frames


def report_real():
    folder = locate("WPDC_GWCS_DATA", "data")
    if folder is None or not (folder / "wircam").is_dir():
        print("real frames: not found, skipped")
        return
    import sep

    catalog = Table.read(folder / "wircam" / "gaia_dr2.fits")
    print(f"{'frame':22s} {'header':18s} sources  pairs  same  scatter/px  rotation/deg  seconds")
    for path in sorted((folder / "wircam").glob("*.fits.fz")):
        with fits.open(path) as hdus:
            data, header = np.ascontiguousarray(hdus[1].data, np.float32), hdus[1].header
        background = sep.Background(data)
        found = sep.extract(data - background, 5.0, err=background.globalrms)
        sources = Table(
            {"x": found["x"], "y": found["y"], "flux": found["flux"], "flags": found["flag"]}
        )
        straight = None
        for name, shift, angle in (
            ("as it is", 0, 0.0),
            ("15 arcsec + 1 deg", 15, 1.0),
            ("-15 arcsec - 1 deg", -15, -1.0),
        ):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                wcs = WCS(header)
            c, s = np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))
            wcs.wcs.cd = wcs.wcs.cd @ [[c, -s], [s, c]]
            step = np.array([0.6 / np.cos(np.deg2rad(wcs.wcs.crval[1])), 0.8])
            wcs.wcs.crval = wcs.wcs.crval + shift * step / 3600
            try:
                matches, diagnostics = match_sources(
                    sources,
                    catalog,
                    wcs,
                    image_shape=data.shape,
                    epoch=Time(header["MJD-OBS"], format="mjd"),
                )
            except MatchError as error:
                print(f"{path.name[:-8]:22s} {name:18s} {error}")
                continue
            pairs = set(
                zip(
                    matches["source_index"].tolist(), matches["catalog_index"].tolist(), strict=True
                )
            )
            straight = straight or pairs
            print(
                f"{path.name[:-8]:22s} {name:18s} {diagnostics.n_sources:7d} {len(pairs):6d} "
                f"{len(pairs & straight):5d} {diagnostics.scatter:11.3f} "
                f"{diagnostics.rotation:13.3f} {sum(diagnostics.timings.values()):8.2f}"
            )


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parts = (
        "lab", "random", "hard", "impossible", "few-impossible", "blind", "refusals", "times",
        "real",
    )  # fmt: skip
    parser.add_argument("part", nargs="*", help=", ".join(parts))
    parser.add_argument("--cases", nargs="+", default=LAB_CASES)
    parser.add_argument("--seeds", nargs="+", type=int, default=[1])
    parser.add_argument("--no-magnitudes", action="store_true", help="lab: hide magnitudes")
    parser.add_argument("--n", type=int, default=30)
    parser.add_argument("--first", type=int, default=0, help="first seed of random cases")
    parser.add_argument("--max-stars", type=float, default=10_000)
    parser.add_argument("--stars", nargs="+", type=float, default=[1e3, 1e4, 1e5, 5e5, 1e6])
    a = parser.parse_args()
    warnings.simplefilter("ignore", RuntimeWarning)
    for part in a.part or parts:
        if part not in parts:
            parser.error(f"no part {part!r}: choose from {', '.join(parts)}")
        if part == "lab":
            report_lab(a.cases, a.seeds, magnitudes=not a.no_magnitudes)
        elif part == "times":
            report_times([int(n) for n in a.stars])
            report_scamp()
        elif part == "refusals":
            report_refusals(max(3, a.n // 10))
        elif part == "hard":
            report_random(a.n, a.first, None, make=make_hard_case, name="hard")
        elif part == "few-impossible":
            report_few_impossible(a.n, a.first)
        elif part == "real":
            report_real()
        else:
            report = {
                "random": report_random,
                "impossible": report_impossible,
                "blind": report_blind,
            }
            report[part](a.n, a.first, a.max_stars)


if __name__ == "__main__":
    main()
