"""Real frames of one detector together and alone: left-out stars, pulls, frames of few stars.

    python benchmarks/joint_real.py [--splits 5] [--draws 3] [--data DIR] [--cache DIR]

Four WIRCam frames of one sensor (``wircam`` in DIR, WPDC_GWCS_DATA or ../shared/data), J and H2,
2011 to 2017, with Gaia DR2.  Each image is measured once, then everything starts from its list of
sources; with --cache the lists are kept as ECSV.

First part: a fifth of the catalog is held out, another one in each split, and the frames are
solved together and each alone.  "joint" and "alone" are the scatters (1.4826 MAD, root mean square
of both axes) of the held-out stars that both have paired, all splits together.  Pulls are those of
the brightest fifth of them by S/N: residual over centroid error and ``calibration.uncertainty``.

Second part: of one frame only 60 (25) stars are left, drawn from those that the solution of all
frames has used, and it is solved with the three other frames and alone.  The frame and its stars
are moved by 90 deg in RA, a rotation of the sky, so that its catalog has these stars only: it is
the solution that is tested, not the match.  Compared are the stars with centroid errors below 8 mas
that were not drawn, as the full solution has paired them; "full" is their scatter in that solution,
which has used them.  At the end each requirement, and whether it is met.
"""

import argparse
import logging
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
from astropy.table import QTable, Table, vstack
from astropy.wcs.utils import proj_plane_pixel_scales
from centroids import scatter
from matching import locate

from wpdc_gwcs import read_catalog
from wpdc_gwcs.calibration import Settings, calibrate, measure_sources
from wpdc_gwcs.catalogs import propagate
from wpdc_gwcs.io import read_frames

HOLDOUT = 0.2
BRIGHT = 8.0  # mas, centroid error
LIMITS = {60: 0.65, 25: 0.75}  # scatter with the others over that alone
ASIDE = 90.0  # deg of RA


def find_frames(folder):
    folder = Path(folder) if folder else locate("WPDC_GWCS_DATA", "data")
    found = sorted((folder / "wircam").glob("*.fits.fz")) if folder else []
    if not found:
        sys.exit(f"no frames found in the folder wircam of {folder} (set WPDC_GWCS_DATA)")
    return found


def measured(path, cache):
    """The frame of an image with its list of sources in memory, and the list."""
    (frame,) = read_frames(path)
    kept = cache / f"{frame.name}.sources.ecsv" if cache else None
    if kept and kept.is_file():
        sources = QTable.read(kept)
    else:
        sources = measure_sources(frame)
        if kept:
            cache.mkdir(parents=True, exist_ok=True)
            sources.write(kept)
    return with_sources(frame, sources), sources


def with_sources(frame, sources):
    return replace(frame, source=frame.name, load_image=None, load_sources=lambda: sources)


def solve(frames, catalog, **options):
    """Calibrations by the name of the frame."""
    run = calibrate(frames, catalog, settings=Settings(**options))
    for row in run.summary:
        if row["status"] == "failed":
            together = "alone" if len(frames) == 1 else "joint"
            print(f"  {row['frame']} {together}: {row['reason'].split(';')[0]}")
    return {c.frame: c for c in run.calibrations}


def residuals(calibration, x, y, ra, dec):
    """Catalog minus position on the sky, (2, N) mas."""
    found_ra, found_dec = calibration.wcs(x, y)
    d_ra = (np.asarray(ra) - found_ra + 180) % 360 - 180
    return 3.6e6 * np.array([d_ra * np.cos(np.radians(dec)), np.asarray(dec) - found_dec])


def both_axes(values):
    """Scatter of both axes, root mean square."""
    return float(np.hypot(*map(scatter, values)) / np.sqrt(2))


def held_out(calibration):
    """Rows of the held-out stars by source and star."""
    matches = calibration.matches
    rows = np.flatnonzero(matches["holdout"])
    keys = zip(matches["source_index"][rows], matches["catalog_index"][rows])
    return {(int(i), int(j)): row for (i, j), row in zip(keys, rows)}


def residuals_of(calibration, rows):
    m = calibration.matches[rows]
    return residuals(calibration, *(np.asarray(m[c], float) for c in ("x", "y", "ra", "dec")))


def pulls_of(calibration, rows):
    m = calibration.matches[rows]
    sigma = calibration.uncertainty(np.asarray(m["x"], float), np.asarray(m["y"], float))[:2]
    return np.array(
        [
            np.asarray(m[f"d{a}"], float) / np.hypot(np.asarray(m[f"{a}_err"], float), s)
            for a, s in zip("xy", sigma)
        ]
    )


def compare_splits(frames, lists, catalog, n_splits):
    """Residuals and pulls of held-out stars by frame: joint, alone, pulls joint, pulls alone."""
    found = {f.name: [[], [], [], []] for f in frames}
    for k in range(n_splits):
        options = {"holdout": HOLDOUT, "seed": k}
        joint = solve(frames, catalog, **options)
        for frame in frames:
            alone = solve([frame], catalog, **options)
            if frame.name not in alone or frame.name not in joint:
                continue
            pair = joint[frame.name], alone[frame.name]
            held = [held_out(c) for c in pair]
            common = sorted(held[0].keys() & held[1].keys())
            snr = np.asarray(lists[frame.name]["snr"], float)[[i for i, _ in common]]
            bright = snr >= np.quantile(snr, 0.8)
            for side, (calibration, rows_of) in enumerate(zip(pair, held)):
                rows = np.array([rows_of[key] for key in common])
                found[frame.name][side].append(residuals_of(calibration, rows))
                found[frame.name][2 + side].append(pulls_of(calibration, rows[bright]))
    return {
        name: [np.concatenate(part, axis=1) for part in parts] if parts[0] else None
        for name, parts in found.items()
    }


def report_splits(found):
    print(
        f"\n{'held-out stars, mas':22s} {'stars':>6s} {'joint':>7s} {'alone':>7s} {'ratio':>6s}  "
        f"{'bright':>6s} {'pull joint':>10s} {'alone':>6s}"
    )
    ratios, pulls, solved = {}, {}, {}
    for name, parts in found.items():
        if parts is None:
            print(f"{name:22s} not solved both together and alone")
            ratios[name] = pulls[name] = np.nan
        else:
            solved[name] = parts
    if solved:
        solved["pooled"] = [np.concatenate(part, axis=1) for part in zip(*solved.values())]
    for name, parts in solved.items():
        joint, alone = map(both_axes, parts[:2])
        pull, pull_alone = (scatter(np.ravel(p)) for p in parts[2:])
        ratios[name] = joint / alone
        pulls[name] = pull
        print(
            f"{name:22s} {parts[0].shape[1]:6d} {joint:7.2f} {alone:7.2f} {joint / alone:6.3f}  "
            f"{parts[2].shape[1]:6d} {pull:10.3f} {pull_alone:6.3f}"
        )
    pooled = ratios.pop("pooled", np.nan)
    pulls.pop("pooled", None)
    worst = np.max(list(ratios.values()))
    yield f"pooled joint / alone: up to 1.00 wanted, {show(pooled)}", pooled <= 1.0
    yield f"worst frame joint / alone: up to 1.10 wanted, {show(worst)}", worst <= 1.1
    yield (
        "pulls of the bright stars, joint: 0.85 to 1.15 wanted, "
        + " ".join(f"{p:.2f}" for p in pulls.values()),
        all(0.85 <= p <= 1.15 for p in pulls.values()),
    )


def aside(frame, gaia):
    """The frame and the catalog moved to another part of the sky."""
    wcs, moved = frame.wcs.deepcopy(), gaia.copy()
    for value in (wcs.wcs.crval[:1], moved["ra"]):
        value[:] = (value + ASIDE) % 360
    wcs.wcs.set()
    return replace(frame, wcs=wcs), moved


def compare_few(frames, lists, gaia, full, n, n_draws):
    """Residuals of bright stars left out, joint and alone, by frame; numbers of solutions."""
    found, solved = {f.name: [[], [], []] for f in frames}, {f.name: [0, 0] for f in frames}
    for frame in frames:
        matches, sources = full[frame.name].matches, lists[frame.name]
        rows = np.asarray(matches["source_index"])
        star = np.asarray(matches["catalog_index"])
        moved_frame, moved = aside(frame, gaia[star])
        at_epoch = propagate(read_catalog(moved), frame.epoch)
        x, y, x_err, y_err = (
            np.asarray(sources[c], float)[rows] for c in ("x", "y", "x_err", "y_err")
        )
        ra, dec = (np.asarray(at_epoch[c], float) for c in ("ra", "dec"))
        scale = np.mean(proj_plane_pixel_scales(frame.wcs)) * 3.6e6
        used = np.flatnonzero(matches["used"])
        bright = np.asarray(matches["used"]) & (np.hypot(x_err, y_err) * scale < BRIGHT * 2**0.5)
        for k in range(n_draws):
            rng = np.random.default_rng([n, k])
            drawn = rng.choice(used, n, replace=False)
            few = with_sources(moved_frame, sources[np.sort(rows[drawn])])
            catalogs = vstack([gaia, moved[drawn]]), moved[drawn]
            left_out = bright & ~np.isin(np.arange(len(rows)), drawn)
            groups = [few if f is frame else f for f in frames], [few]
            sides = [solve(g, read_catalog(c)).get(frame.name) for g, c in zip(groups, catalogs)]
            for side, calibration in enumerate(sides):
                solved[frame.name][side] += calibration is not None
            if None in sides:
                continue
            # The full solution has the frame in its own place.
            for side, (calibration, turned) in enumerate(
                zip((*sides, full[frame.name]), (0.0, 0.0, ASIDE))
            ):
                places = (a[left_out] for a in (x, y, ra - turned, dec))
                found[frame.name][side].append(residuals(calibration, *places))
    return found, solved


def report_few(found, solved, n, n_draws):
    print(
        f"\n{f'{n} stars left, mas':22s} {'draws':>6s} {'solved: joint':>13s} {'alone':>6s} "
        f"{'bright':>7s} {'joint':>7s} {'alone':>7s} {'ratio':>6s} {'full':>6s}"
    )
    pooled, total = [[], [], []], np.zeros(2, int)
    for name, sides in found.items():
        print_few(name, n_draws, solved[name], sides)
        total += solved[name]
        for all_frames, side in zip(pooled, sides):
            all_frames += side
    ratio = print_few("pooled", n_draws * len(found), total, pooled)
    yield (
        f"{n} stars, joint / alone: up to {LIMITS[n]:.2f} wanted, {show(ratio)} "
        f"({total[0]} and {total[1]} of {n_draws * len(found)} solved)",
        ratio <= LIMITS[n] and total[0] == n_draws * len(found),
    )


def show(number):
    return "-" if np.isnan(number) else f"{number:.3f}"


def print_few(name, n_draws, solved, sides):
    line = f"{name:22s} {n_draws:6d} {solved[0]:13d} {solved[1]:6d} "
    if not sides[0]:
        print(line + f"{'-':>7s} {'-':>7s} {'-':>7s} {'-':>6s} {'-':>6s}", flush=True)
        return np.nan
    joint, alone, full = (both_axes(np.concatenate(side, axis=1)) for side in sides)
    n_bright = sum(part.shape[1] for part in sides[0])
    line += f"{n_bright:7d} {joint:7.2f} {alone:7.2f} {joint / alone:6.3f} {full:6.2f}"
    print(line, flush=True)
    return joint / alone


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--splits", type=int, default=5)
    parser.add_argument("--draws", type=int, default=3, help="for every frame of few stars")
    parser.add_argument("--data", help="folder in which wircam is")
    parser.add_argument("--cache", type=Path, help="folder to keep the lists of sources in")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    logging.getLogger("wpdc_gwcs").setLevel(logging.ERROR)
    paths = find_frames(options.data)
    frames, lists = [], {}
    for path in paths:
        frame, sources = measured(path, options.cache)
        frames.append(frame)
        lists[frame.name] = sources
    gaia = Table.read(paths[0].parent / "gaia_dr2.fits")
    catalog = read_catalog(gaia)
    checks = []
    if options.splits:
        found = compare_splits(frames, lists, catalog, options.splits)
        checks += report_splits(found)
    if options.draws:
        full = solve(frames, catalog)
        for n in LIMITS:
            found, solved = compare_few(frames, lists, gaia, full, n, options.draws)
            checks += report_few(found, solved, n, options.draws)
    print()
    for line, met in checks:
        print(f"{'ok' if met else 'MISSED':6s}  {line}")


if __name__ == "__main__":
    main()
