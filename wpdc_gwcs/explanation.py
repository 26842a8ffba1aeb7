"""Explanation of why a frame is solved, degraded or refused, stage by stage.

::

    frame --> sources --> catalog --> match --> solution
              each is a Stage, described in words; the first one that fails is the last
"""

import shlex
from dataclasses import dataclass, replace

import numpy as np

from wpdc_gwcs.calibration.camera import solve_camera
from wpdc_gwcs.calibration.matched import (
    MatchedFrame,
    match_frame,
    reference_in_reach,
    sky_of_frame,
    with_errors,
)
from wpdc_gwcs.calibration.measure import measure_sources, rules_of
from wpdc_gwcs.calibration.settings import Settings
from wpdc_gwcs.calibration.start import (
    detector_center,
    header_reference_point,
    linear_wcs,
    sky_of,
)
from wpdc_gwcs.calibration.story import tell_match, tell_sources
from wpdc_gwcs.catalogs import (
    Region,
    catalog_source,
    fill_motions,
    read_catalog,
    split_extension,
)
from wpdc_gwcs.columns import numbers_or_nan
from wpdc_gwcs.counts import counted
from wpdc_gwcs.detector import detector_label
from wpdc_gwcs.exceptions import MatchError, WPDCError
from wpdc_gwcs.extras import PLOT, missing
from wpdc_gwcs.io.tan import TanHeader
from wpdc_gwcs.models import PVPolynomial

__all__ = ["Explanation", "Stage", "explain_frame"]

# Minimum number of stars for a match, and number that makes it easy.
_FEW, _PLENTY = 8, 30
# A larger relative error of the scale is an error of the header; a blind search finds smaller ones.
_SCALE_OFF = 0.03
# Trials: options, settings, factor of the scale.
_FAINTER = "--min-snr 3 --max-roundness 1", {"min_snr": 3.0, "max_roundness": 1.0}, 1.0
# Scales that are tried, relative to that of the header: headers often have that of another binning.
_SCALES = (1.0, 0.5, 2.0)
# Residuals this many times the errors are worth a word; stated errors are often half the true ones.
_OVER_ERRORS = 4


@dataclass(frozen=True)
class Stage:
    """One stage of a frame.

    Parameters
    ----------
    name : str
        Name of the stage.
    went_well : bool
        Whether the next stage could begin.
    lines : tuple of str
        Results in words.
    """

    name: str
    went_well: bool
    lines: tuple


@dataclass(frozen=True, eq=False)
class Explanation:
    """The result for a frame, stage by stage, with reasons.

    Parameters
    ----------
    frame : Frame
        The frame.
    status : str
        ``solved``, ``degraded`` or ``failed``.
    reasons : tuple of str
        Its limitations, or the error.
    stages : tuple of Stage
        The stages that were reached.
    advice : tuple of str
        What to try next.
    sources : `~astropy.table.Table` or None
        Measured sources.
    usable : (N,) ndarray or None
        Mask over the sources.
    starts, references : (N, 2) ndarray or None
        Usable sources, and reference stars at the epoch of the frame, in pixels of the header.
    match : MatchedFrame or None
        The match, if there is one.
    calibration : Calibration or None
        The result, if there is one.
    """

    frame: object
    status: str
    reasons: tuple
    stages: tuple
    advice: tuple
    sources: object = None
    usable: np.ndarray | None = None
    starts: np.ndarray | None = None
    references: np.ndarray | None = None
    match: MatchedFrame | None = None
    calibration: object = None


class _Story:
    """Collected results."""

    def __init__(self, frame, settings):
        self.frame, self.settings = frame, settings
        self.stages, self.advice, self.found = [], [], {}
        self.in_reach, self.has_fainter = 0, True

    def tell(self, name, *lines, went_well=True):
        self.stages.append(Stage(name, bool(went_well), tuple(lines)))

    def end(self, status, reasons):
        parts = (reasons, self.stages, dict.fromkeys(self.advice))
        return Explanation(self.frame, status, *(tuple(part) for part in parts), **self.found)

    def fail(self, name, error, *lines):
        text = " ".join(str(error).split())
        self.tell(name, *lines, text, went_well=False)
        return self.end("failed", (text,))


def explain_frame(frame, catalog, settings=None):
    """Go through a frame stage by stage, and describe the results and what to try.

    Parameters
    ----------
    frame : Frame
        Image or source list.
    catalog : path-like, Table, SkyCoord, GaiaArchive or HatsCatalog
        As for `read_catalog`.
    settings : Settings, optional
        Settings, as for `calibrate`.

    Returns
    -------
    Explanation
        The explanation, even if the frame fails.  The frame is solved by itself, without others of
        its camera.

    Raises
    ------
    InputError
        If the catalog cannot be read.

    Examples
    --------
    >>> from wpdc_gwcs import simulate
    >>> from wpdc_gwcs.explanation import explain_frame
    >>> sky = simulate(1, image_shape=(512, 512), density=60.0, distortion=5.0)
    >>> told = explain_frame(sky.exposures[0].frame(), sky.reference)
    >>> told.status, [stage.name for stage in told.stages]
    ('solved', ['frame', 'sources', 'catalog', 'match', 'solution'])
    """
    settings = Settings() if settings is None else settings
    story = _Story(frame, settings)
    sky = sky_of_frame(frame, settings)
    if sky is None:
        story.advice.append("give a header with a celestial WCS (--wcs HEADER)")
        return story.fail(
            "frame", MatchError(f"{frame.source}: its WCS gives no position on the sky")
        )
    _tell_frame(story)
    try:
        sources = with_errors(measure_sources(frame, settings))
    except WPDCError as error:
        _advise_on_sources(story, error)
        return story.fail("sources", error)
    usable = _tell_sources(story, sources)
    stars = fill_motions(
        read_catalog(catalog_source(catalog, max_mag=settings.max_mag), region=Region(*sky))
    )
    start = linear_wcs(frame.wcs, header_reference_point(frame))
    x, y = (np.asarray(sources[name], float)[usable] for name in ("x", "y"))
    story.found["starts"] = np.column_stack(start.pixels(*sky_of(frame.wcs, x, y)))
    try:
        reference = reference_in_reach(frame, stars, start, settings)
    except MatchError as error:
        story.advice.append(
            "if the header points elsewhere, give another one: --wcs HEADER"
            + (", with the right ascension in degrees" if "in hours" in str(error) else "")
        )
        story.advice.append(
            "if it is right, use a catalog of this part of the sky: wpdc catalog prepare gaia "
            f"--around {shlex.quote(frame.source)} --output gaia.fits"
        )
        return story.fail("catalog", error, f"{counted(len(stars), 'star')} read from the catalog")
    _tell_catalog(story, stars, reference, start)
    try:
        match = match_frame(frame, stars, settings, sources=sources)
    except MatchError as error:
        _advise_on_match(story, stars, sources, error)
        return story.fail("match", error)
    _tell_match(story, match)
    _, calibrations, failures = solve_camera([match], settings)
    if failures:
        story.advice.append(
            "solve it together with other frames of its camera, or with a --solution"
        )
        return story.fail("solution", next(iter(failures.values())))
    return _tell_solution(story, calibrations[0])


def _tell_frame(story):
    frame = story.frame
    ny, nx = frame.image_shape
    ra, dec = (float(c[0]) for c in sky_of(frame.wcs, [(nx - 1) / 2], [(ny - 1) / 2]))
    start = linear_wcs(frame.wcs, header_reference_point(frame))
    epoch = "no epoch" if frame.epoch is None else f"epoch {frame.epoch:.3f}"
    kind = "an image" if frame.load_image is not None else "a list of sources"
    parts = (f"{kind} of {nx} x {ny} px", detector_label(frame.detector), epoch)
    story.tell(
        "frame",
        f"{frame.name}: {', '.join(filter(None, parts))}",
        f"the header has its center at RA {ra:.5f} Dec {dec:.5f} deg, "
        f"{start.scale * 3600:.4g} arcsec / px",
    )
    if frame.epoch is None:
        story.advice.append(
            "say when it was taken, so that proper motions can be applied: --epoch DATE"
        )


def _tell_sources(story, sources):
    rules = rules_of(sources, story.frame, story.settings)
    usable = ~np.any(list(rules.values()), axis=0)
    story.found |= {"sources": sources, "usable": usable}
    # There are always fainter stars on an image.
    listed = any(out.any() for name, out in rules.items() if name.startswith("below S/N"))
    story.has_fainter = listed or story.frame.load_image is not None
    lines = tell_sources(sources, story.frame, story.settings)
    story.tell("sources", *lines, went_well=usable.sum() >= _FEW)
    if usable.sum() < _PLENTY:
        options = {"not round": "--max-roundness", "below S/N": "--min-snr"}
        if story.frame.load_image is not None:
            # A list has been measured already.
            options |= {"saturated": "--saturation", "": "--threshold"}
        worst = max(rules, key=lambda name: rules[name].sum())
        option = next((o for word, o in options.items() if word in worst), None)
        if rules[worst].any():
            n, see = int(rules[worst].sum()), "" if option is None else f": see {option}"
            story.advice.append(f"{counted(n, 'source')} left out as {worst}{see}")
    return usable


def _tell_catalog(story, stars, reference, start):
    ny, nx = story.frame.image_shape
    x, y = start.pixels(np.asarray(reference["ra"]), np.asarray(reference["dec"]))
    story.found["references"] = np.column_stack([x, y])
    inside = int(np.sum((x > 0) & (x < nx) & (y > 0) & (y < ny)))
    story.in_reach = len(reference)
    lines = [
        f"{len(reference)} of {counted(len(stars), 'star')} in reach, {inside} on the frame by "
        "its header"
    ]
    if "pmra" not in reference.colnames:
        lines.append("it has no proper motions")
    story.tell("catalog", *lines, went_well=inside >= _FEW)
    n = int(np.sum(story.found["usable"]))
    if inside > 20 * max(n, 1) and n >= _FEW:
        story.advice.append("the catalog is far deeper than the frame: try --max-mag")
    source = shlex.quote(story.frame.source)
    if inside < _FEW and len(reference) >= _PLENTY:
        story.advice.append(
            "the header may point elsewhere, or the catalog does not cover the frame: give another "
            f"header (--wcs HEADER), or wpdc catalog prepare gaia --around {source} --output "
            "gaia.fits"
        )
    elif n > 20 * max(inside, 1):
        story.advice.append(
            "the frame is far deeper than the catalog: use a deeper one, such as wpdc catalog "
            f"prepare gaia --around {source} --output gaia.fits"
        )


def _tell_match(story, match):
    story.found["match"] = match
    story.tell("match", *tell_match(match.diagnostics))


def _tell_solution(story, calibration):
    statistics = calibration.statistics
    story.found["calibration"] = calibration
    residuals = statistics["residuals"]
    reasons = tuple(statistics["reasons"])
    story.tell(
        "solution",
        f"{statistics['n_used']} of {statistics['n_matched']} pairs used, residuals of "
        f"{residuals['sigma_dx']:.4f} and {residuals['sigma_dy']:.4f} px, "
        f"{statistics['rms_mas']:.2f} mas",
        *(f"lacks: {reason}" for reason in reasons),
        went_well=not reasons,
    )
    ratio = _over_errors(story.found["match"], residuals)
    if ratio > _OVER_ERRORS:
        story.advice.append(
            f"the residuals are {ratio:.0f} times the expected errors of the positions: check "
            "how these were measured (focus, trailed stars, errors in the list)"
        )
    # A missing epoch has its own advice.
    if any("no epoch" not in reason for reason in reasons):
        story.advice.append(
            "solve it with dithered exposures of the same detector, with the other detectors of "
            "its camera, or with a --solution"
        )
    return story.end(statistics["status"], reasons)


def _over_errors(match, residuals):
    """Ratio of the scatter of the residuals to the errors of sources and reference stars."""
    i, j = match.pairs
    source = numbers_or_nan(match.sources, "x_err")[i]
    star = numbers_or_nan(match.reference, "ra_error")[j] / (3.6e6 * match.start.scale)
    expected = np.median(np.hypot(source, np.nan_to_num(star)))
    return min(residuals["sigma_dx"], residuals["sigma_dy"]) / expected


def _advise_on_sources(story, error):
    name = shlex.quote(story.frame.source)
    picture = "" if missing(*PLOT) else " --output look.png"
    if story.frame.load_image is None:
        story.advice.append(f"look at the list: wpdc show {name}")
    elif "sigma on the image" in str(error):
        story.advice.append("if there are faint stars: --threshold 3")
        story.advice.append(f"look at the image: wpdc show {name}{picture}")
    elif "signal-to-noise" in str(error):
        story.advice.append("use fainter ones: --min-snr 5; if the gain is wrong, --gain")
    else:
        story.advice.append(f"look at the image: wpdc show {name}{picture}")


def _advise_on_match(story, stars, sources, error):
    """Find out why nothing matched, and what would."""
    n = int(np.sum(story.found["usable"]))
    if error.found is not None:
        _advise_on_header(story, stars, sources, error.found)
    elif story.in_reach < _FEW:
        story.advice.append(
            f"{_FEW} reference stars are needed, and the catalog has {story.in_reach} in reach"
        )
    elif n < _FEW:
        faint = "--min-snr 5" if story.frame.load_image is None else "--threshold 3 --min-snr 5"
        more = f"use fainter ones ({faint}), or " if story.has_fainter else ""
        story.advice.append(
            f"{_FEW} sources are needed, {n} can be used: {more}solve it with the other detectors "
            "of its camera, or with a --solution"
        )
    elif not _try(story, stars, sources, [_FAINTER, *_other_headers(story, _SCALES)]):
        story.advice.append(
            "neither a blind search, nor half or twice the scale, nor fainter stars match: check "
            "whether frame and catalog show the same sky, and whether the scale is right "
            "(--pixel-scale)"
        )
        path, extension = split_extension(story.frame.source)
        if extension is not None:
            story.advice.append(
                "solve it with the other detectors of its exposure, from which it may be matched: "
                f"wpdc calibrate {shlex.quote(str(path))} ..."
            )


def _advise_on_header(story, stars, sources, found):
    """Suggest what to do about a match that is too far from the header."""
    scale = found["scale"]
    off = (
        f"a match was found with the header off by {found['shift'][0]:.0f}, "
        f"{found['shift'][1]:.0f} px, turned by {found['rotation']:.2f} deg, and a scale of "
        f"{_scale_of(story.frame) * scale:.5g} arcsec / px"
    )
    factors = [scale if abs(scale - 1) > _SCALE_OFF else 1.0]
    if not _try(story, stars, sources, _other_headers(story, factors)):
        story.advice.append(
            f"{off}: if that is right, correct the header, or give a better one (--wcs HEADER)"
        )


def _scale_of(frame):
    """Scale of the header, arcsec / px."""
    return linear_wcs(frame.wcs, header_reference_point(frame)).scale * 3600


def _other_headers(story, factors):
    """List trials for other scales of the header, each also with a blind search."""
    trials = []
    for factor in factors:
        if factor == 1:
            trials.append(("--blind", {"blind": True}, factor))
            continue
        scale = f"--pixel-scale {_scale_of(story.frame) * factor:.5g}"
        trials += [(scale, {}, factor), (f"{scale} --blind", {"blind": True}, factor)]
    return trials


def _try(story, stars, sources, trials, *, follow=True):
    """Advise on the first options that match the frame; return whether there are any.

    If a match is refused for its scale, this scale is tried instead of the other options.
    """
    name, settings = shlex.quote(story.frame.source), story.settings
    for options, changes, factor in trials:
        other = replace(settings, **changes)
        if other == settings and factor == 1:
            continue
        try:
            match = match_frame(_scaled(story.frame, factor), stars, other, sources=sources)
        except MatchError as error:
            scale = 1.0 if error.found is None else error.found["scale"]
            if follow and abs(scale - 1) > _SCALE_OFF:
                better = _other_headers(story, [factor * scale])
                return _try(story, stars, sources, better, follow=False)
            continue
        except WPDCError:
            continue
        found = match.diagnostics
        story.advice.append(
            f"it matches with {options} ({counted(found.n_pairs, 'pair')}; the header is off by "
            f"{np.hypot(*found.shift):.0f} px and {found.rotation:.1f} deg"
            f"{', mirrored' if found.parity < 0 else ''}): wpdc calibrate {name} {options} ..."
        )
        return True
    return False


def _scaled(frame, factor):
    """Return a frame whose header has another scale, without its distortion."""
    if factor == 1:
        return frame
    start = linear_wcs(frame.wcs, detector_center(frame.image_shape))
    scaled = TanHeader(
        start.crpix, factor * start.cd, start.crval, PVPolynomial(1), frame.image_shape
    )
    return replace(frame, wcs=scaled.to_wcs())
