"""The alternation of attitudes, polynomial and table."""

import logging
from dataclasses import asdict, replace

import numpy as np
from numpy.polynomial.legendre import legvander

from wpdc_gwcs.exceptions import FitError
from wpdc_gwcs.fitting import (
    MIN_STARS_ATTITUDE,
    WPDCFitter,
    fit_attitude,
    robust_sigma,
    solve_linear,
)
from wpdc_gwcs.instrument._errors import attitude_variance, error_model, pool_linear, worse_scatter
from wpdc_gwcs.instrument._pairs import check_coverage
from wpdc_gwcs.instrument.exposure import ExposureFit, InstrumentResult
from wpdc_gwcs.lookup import N_FOLDS, ResidualMap, build_lookup_table, choose_table
from wpdc_gwcs.models import PVPolynomial, deproject, project, pv_terms
from wpdc_gwcs.solution import DistortionSolution

log = logging.getLogger(__name__)


# Alternation ends when no exposure moves by more than this anywhere, px.
_TOLERANCE = 1e-4
_DRAFT_TOLERANCE = 1e-2
_MAX_ROUNDS = 12

# Degree of the smooth surface that stands in for the instrument while outliers are found, and stars
# per coefficient.
_ALIGN_DEGREE = 7
_STARS_PER_TERM = 12

# Scatter that no distortion model leaves of right pairs, px.
_MAX_SCATTER = 2.0

# Uncertainty at the far corner of the detector beyond which an attitude is not delivered, px.
_MAX_CORNER_SIGMA = 1.0

# Fewer exposures do not tell how much attitudes vary.
_MIN_EXPOSURES_POOL = 5

# How much larger residuals may be in one part of the detector than elsewhere before they are
# taken for outliers, once the instrument is known.
_MAX_LOCAL_SCALE = 10.0

# An exposure whose scatter is this many times that of the others has wrong pairs.
_REJECT_RATIO = 4.0


class Solver:
    """State of the alternation: attitudes, instrument, residuals, errors, what is kept."""

    def __init__(self, pairs, weight, clip, *, pool, seed):
        self.pairs, self.weight, self.clip, self.pool = pairs, weight, clip, pool
        self.crval = [np.array(e.crval, dtype=float) for e in pairs.exposures]
        self.cd = [np.array(e.cd, dtype=float) for e in pairs.exposures]
        self.covariance = [np.full((6, 6), np.nan) for _ in pairs.exposures]
        self.reason = [None] * len(pairs.exposures)
        self.kept = pairs.valid.copy()
        self.sigma = pairs.sigma.copy()
        self.residual = np.full((2, len(pairs)), np.nan)
        self.scale = np.ones(len(pairs.exposures))
        self.error_models = {}
        self.table = self.table_info = self.residual_map = None
        self.own_pv = [None] * len(pairs.exposures)
        self.pv = self.pv_covariance = self.cd0 = None
        self.rng = np.random.default_rng(seed)
        self.rounds = 0
        self.pooled = {}

    @property
    def active(self):
        """Indices of the exposures that are not left out."""
        return [k for k, reason in enumerate(self.reason) if reason is None]

    def reject(self, k, reason):
        """Leave an exposure out; the last one takes the solution with it."""
        name = self.pairs.exposures[k].name
        log.warning("exposure %s left out: %s", name, reason)
        self.reason[k] = reason
        self.kept[self.pairs.slices[k]] = False
        if not self.active:
            if len(self.reason) == 1:
                raise FitError(f"exposure {name}: {reason}")
            reasons = "; ".join(f"{e.name}: {r}" for e, r in zip(self.pairs.exposures, self.reason))
            raise FitError(f"all {len(self.reason)} exposures were left out: {reasons}")

    def fit_attitudes(self, z):
        """Six numbers per exposure from the undistorted positions z (about the reference point)."""
        p = self.pairs
        for k in self.active:
            s = p.slices[k]
            try:
                fit = fit_attitude(
                    z[0, s], z[1, s], p.ra[s], p.dec[s], crpix=(0.0, 0.0), crval=self.crval[k],
                    cd=self.cd[k], x_err=self.sigma[0, s], y_err=self.sigma[1, s], clip=np.inf,
                    used=self.kept[s],
                )  # fmt: skip
            except FitError as error:
                self.reject(k, str(error))
                continue
            self.crval[k], self.cd[k], self.covariance[k] = fit.crval, fit.cd, fit.covariance
            self.residual[0, s], self.residual[1, s] = fit.dx, fit.dy

    def clip_outliers(self, *, local=np.inf, relax=1.0):
        """Decide anew which pairs are kept; true where nothing changed.

        A pair is compared with those about it on the detector and with those of its exposure:
        where the instrument is not yet known, which may be far from where most stars are, all
        residuals are large, and clipping them would keep it unknown.  ``local`` limits how much
        larger they may be than elsewhere; ``relax`` multiplies the clipping limit.
        """
        p = self.pairs
        normalised = np.abs(self.residual) / self.sigma
        usable = p.valid & np.isfinite(normalised).all(0)
        for k, reason in enumerate(self.reason):
            if reason is not None:
                usable[p.slices[k]] = False
        overall = worse_scatter(normalised[:, usable])
        g = int(np.clip(np.sqrt(usable.sum() / 100), 1, 12))
        ny, nx = p.image_shape
        x, y = p.x[usable], p.y[usable]
        cell = np.clip((x + 0.5) * g / nx, 0, g - 1).astype(int) * g
        cell += np.clip((y + 0.5) * g / ny, 0, g - 1).astype(int)
        order = np.argsort(cell, kind="stable")
        scale = np.full(g * g, overall)
        for part in np.split(order, np.flatnonzero(np.diff(cell[order])) + 1):
            scale[cell[part[0]]] = worse_scatter(normalised[:, usable][:, part])
        limit = np.zeros(len(p))
        limit[usable] = np.clip(scale[cell], overall, local * overall)
        for k in self.active:
            s = p.slices[k]
            if np.any(usable[s]):
                self.scale[k] = worse_scatter(normalised[:, s][:, usable[s]])
                limit[s] = np.maximum(limit[s], self.scale[k])
        limit = relax * self.clip * np.maximum(limit, 1e-10)
        kept = usable & (np.max(np.where(usable, normalised, 0.0), axis=0) <= limit)
        same = np.array_equal(kept, self.kept)
        self.kept = kept
        return same

    def reference(self, z):
        """Undistorted position of the reference stars in each exposure's own attitude."""
        return z - self.residual

    def project_reference(self, k):
        """Project the stars of one exposure about its CRVAL, px from the reference point."""
        s = self.pairs.slices[k]
        plane = np.array(project(self.pairs.ra[s], self.pairs.dec[s], self.crval[k]))
        return np.linalg.solve(self.cd[k], plane)

    def move(self, k, shift, matrix):
        """Replace an attitude exactly by that of positions ``shift + matrix @ z``."""
        self.crval[k] = np.array(deproject(*(self.cd[k] @ shift), self.crval[k]))
        self.cd[k] = self.cd[k] @ matrix

    def align(self):
        """Attitudes, outliers and errors, with a smooth surface for the instrument."""
        p = self.pairs
        n = int(p.valid.sum())
        check_coverage(p)
        degree = max(
            [
                d
                for d in range(1, _ALIGN_DEGREE + 1)
                if _STARS_PER_TERM * (d + 1) * (d + 2) // 2 <= n
            ],
            default=1,
        )
        a, b = legvander(p.u, degree), legvander(p.v, degree)
        basis = np.stack(
            [a[:, t - j] * b[:, j] for t in range(degree + 1) for j in range(t + 1)], axis=1
        )
        position = np.where(p.finite, np.array([p.x, p.y]) - p.crpix[:, None], 0.0)
        surface, before = np.zeros((basis.shape[1], 2)), None
        for turn in range(_MAX_ROUNDS):
            z = position + (basis @ surface).T
            self.fit_attitudes(z)
            # Distortion that is not yet in the surface is not noise: clip little at first.
            self.clip_outliers(relax=max(1.0, 8.0 / 2**turn))
            target = self.reference(z) - position
            surface = self._fit_surface(basis, target)
            residual = position + (basis @ surface).T - self.reference(z)
            if turn >= 3:
                moved = np.sqrt(np.mean((residual - before)[:, self.kept] ** 2))
                if moved < 1e-2 * np.median(np.abs(residual[:, self.kept])):
                    break
            before = residual
        self._reject_exposures()
        self.rescale_errors(basis.shape[1] - 3)

    def _fit_surface(self, basis, target):
        # An exposure with wrong pairs has a large scatter and counts for nothing.
        weight = np.where(self.kept, 1.0, 0.0) / self.sigma**2
        for k in self.active:
            weight[:, self.pairs.slices[k]] /= max(self.scale[k], 1e-6) ** 2
        target = np.where(self.kept, target, 0.0)
        surface = np.empty((basis.shape[1], 2))
        for axis in range(2):
            weighted = basis * weight[axis][:, None]
            # Legendre products: well conditioned, and what the stars do not determine stays zero.
            surface[:, axis] = np.linalg.lstsq(
                basis.T @ weighted, weighted.T @ target[axis], rcond=1e-11
            )[0]
        return surface

    def _reject_exposures(self):
        scales = {k: self._scatter(k) for k in self.active}
        typical = np.median(list(scales.values()))
        for k, scatter in scales.items():
            if len(scales) > 2 and scatter > _REJECT_RATIO * typical:
                self.reject(
                    k,
                    f"its residuals scatter by {scatter:.3g} px, those of the others by "
                    f"{typical:.3g} px: wrong pairs",
                )
            elif scatter > _MAX_SCATTER:
                self.reject(k, f"its residuals scatter by {scatter:.3g} px: wrong pairs")

    def _scatter(self, k):
        s = self.pairs.slices[k]
        valid = self.pairs.valid[s]
        return worse_scatter(self.residual[:, s][:, valid])

    def rescale_errors(self, n_parameters=None):
        """Scale and floor of the errors from the residuals; see `error_model`."""
        p = self.pairs
        kept = self.kept
        n = int(kept.sum())
        if n_parameters is None:
            n_parameters = len(self.pv.term_indices) - 3
            if self.table_info is not None:
                n_parameters = max(n_parameters, self.table_info.choice.freedom - 3)
        freedom = n_parameters + 3 * len(self.active)
        inflation = np.sqrt(n / max(n - freedom, 0.1 * n))
        self.error_models = {}
        for name, members in (("stated", p.has_errors), ("unknown", ~p.has_errors)):
            group = kept & members
            if not np.any(group):
                continue
            scale, floor = error_model(
                self.residual[:, group] * inflation, p.sigma[:, group], fit_floor=name == "stated"
            )
            self.sigma[:, members] = np.sqrt((scale * p.sigma[:, members]) ** 2 + floor**2)
            self.error_models[name] = {"n": int(group.sum()), "scale": scale, "floor": floor}

    def solve(self, cd, degree, n_grid, lut, *, choice, draft):
        """PV, table and attitudes in turn."""
        if cd is None:
            cd = np.mean([self.cd[k] for k in self.active], axis=0)
        self.cd0 = np.array(cd, dtype=float)
        self.degree = self._affordable_degree(degree)
        folds = self._folds()
        places, candidates = None, ()
        for self.rounds in range(1, _MAX_ROUNDS + 1):
            self.fit_pv()
            z = self.polynomial_positions(self.pairs.x, self.pairs.y)
            if lut != "none":
                self.residual_map = self._residual_map(z, folds)
                if choice is None and self.rounds == 2 and not draft:
                    choice, candidates = choose_table(self.residual_map, lut=lut)
                self.table, self.table_info = build_lookup_table(
                    self.residual_map, n_grid, choice=choice, lut=lut, draft=True
                )
            self.settle_attitudes(z)
            if self.rounds == 1:
                # The surface of the alignment may have left structure that the table takes: the
                # errors are only now what they are, and the table's settings are chosen with them.
                self.rescale_errors()
            places, moved = self._places(places)
            if moved < (_TOLERANCE if not draft else _DRAFT_TOLERANCE):
                break
        if self.table is not None and not draft:
            self.residual_map = self._residual_map(z, folds)
            self.table, info = build_lookup_table(self.residual_map, n_grid, choice=choice, lut=lut)
            self.table_info = replace(info, candidates=candidates)
            self.settle_attitudes(z)
        self.rescale_errors()
        log.info("instrument solved in %d rounds from %d pairs", self.rounds, self.kept.sum())

    def attach(self, solution):
        """Attitudes only, with a stored instrument."""
        self.cd0, self.pv, self.degree = solution.cd, solution.pv, solution.pv.degree
        self.pv_covariance = solution.pv_covariance
        self.table, self.table_sigma = solution.lookup_table, solution.table_sigma
        self.residual_map = solution.residual_map
        z = self.polynomial_positions(self.pairs.x, self.pairs.y)
        for _ in range(_MAX_ROUNDS):
            self.fit_attitudes(self.apply_table(z))
            if self.clip_outliers():
                break
        self._reject_exposures()
        self.rescale_errors()
        self.settle_attitudes(z)
        self._reject_unconstrained()

    def update(self, solution, n_grid, *, choice, draft):
        """Table anew from the stored residuals and those of these exposures."""
        if solution.residual_map is None:
            raise FitError("the stored solution holds no residual map: it cannot be updated")
        z = self.polynomial_positions(self.pairs.x, self.pairs.y)
        folds = self._folds()
        candidates, places = (), None
        for self.rounds in range(1, _MAX_ROUNDS + 1):
            self.residual_map = solution.residual_map + self._residual_map(z, folds)
            if choice is None and not draft:
                choice, candidates = choose_table(self.residual_map)
            self.table, self.table_info = build_lookup_table(
                self.residual_map, n_grid, choice=choice, draft=True
            )
            self.settle_attitudes(z)
            places, moved = self._places(places)
            if moved < (_TOLERANCE if not draft else _DRAFT_TOLERANCE):
                break
        if self.table is not None and not draft:
            self.table, info = build_lookup_table(self.residual_map, n_grid, choice=choice)
            self.table_info = replace(info, candidates=candidates)
            self.settle_attitudes(z)
        self.rescale_errors()

    def _affordable_degree(self, degree):
        p = self.pairs
        distance = np.hypot(p.x - p.crpix[0], p.y - p.crpix[1])[self.kept]
        n = int(np.sum(self.weight(distance) > 0.5))
        if n < MIN_STARS_ATTITUDE:
            raise FitError(
                f"only {n} of {distance.size} stars have a weight above 0.5 ({self.weight.name}, "
                f"r0 = {self.weight.r0:.6g} px); {MIN_STARS_ATTITUDE} are needed"
            )
        lowered = degree
        while lowered > 1 and 3 * len(pv_terms(lowered).index) > n:
            lowered -= 1
        if lowered < degree:
            log.warning(
                "%d stars within r0: PV polynomial of degree %d, not %d", n, lowered, degree
            )
        return lowered

    def _folds(self):
        """Group of each pair for cross-validation: by exposure, or at random for one or two."""
        folds = self.rng.integers(0, N_FOLDS, len(self.pairs))
        if len(self.active) >= 3:
            for i, k in enumerate(self.active):
                folds[self.pairs.slices[k]] = i % N_FOLDS
        return folds

    def fit_pv(self):
        """Weighted polynomial of all exposures; its linear part goes into the attitudes."""
        p = self.pairs
        reference = np.zeros((2, len(p)))
        for k in self.active:
            reference[:, p.slices[k]] = self.project_reference(k)
        fitter = WPDCFitter(weight=self.weight, pixel_scale=self.cd0)
        kept = self.kept
        self.pv = fitter(
            PVPolynomial(self.degree),
            *(self.cd0 @ self._offset(p.x, p.y)[:, kept]),
            *(self.cd0 @ reference[:, kept]),
            weights=1.0 / np.sqrt(self.cd0**2 @ self.sigma[:, kept] ** 2),
        )
        n = len(self.pv.term_indices)
        full = fitter.fit_info["covariance"]
        self.pv_covariance = _blocks(full, n)
        self.pv, constant, linear = _split_linear(self.pv)
        inverse = np.linalg.inv(self.cd0)
        for k in self.active:
            self.move(k, inverse @ constant, inverse @ linear @ self.cd0)

    def _offset(self, x, y):
        return np.array([x, y]) - self.pairs.crpix.reshape(2, *[1] * np.ndim(x))

    def polynomial_positions(self, x, y, pv=None):
        """Positions about the reference point after the polynomial, px."""
        xi, eta = np.tensordot(self.cd0, self._offset(x, y), axes=1)
        plane = np.array((self.pv if pv is None else pv)(xi, eta))
        return np.tensordot(np.linalg.inv(self.cd0), plane, axes=1)

    def apply_table(self, z):
        """Undistorted positions of all pairs about the reference point."""
        if self.table is None:
            return z
        p = self.pairs
        # Pairs off the detector get no residual; the table must not make NaN of them on the way.
        ny, nx = p.image_shape
        x, y = (np.where(p.finite, a, 0.5 * n) for a, n in ((p.x, nx), (p.y, ny)))
        return z - np.array(self.table(x, y))

    def _residual_map(self, z, folds):
        p, kept = self.pairs, self.kept
        reference = np.zeros_like(z)
        for k in self.active:
            reference[:, p.slices[k]] = self.project_reference(k)
        dx, dy = (z - reference)[:, kept]
        return ResidualMap.from_residuals(
            p.x[kept], p.y[kept], dx, dy, x_err=self.sigma[0, kept], y_err=self.sigma[1, kept],
            image_shape=p.image_shape, fold=folds[kept],
        )  # fmt: skip

    def settle_attitudes(self, z):
        """Fit all attitudes with the instrument fixed, drawn together where they do not differ."""
        z = self.apply_table(z)
        self.fit_attitudes(z)
        if self.pool:
            self._pool(z)
        self.clip_outliers(local=_MAX_LOCAL_SCALE)

    def _pool(self, z):
        active = self.active
        if len(active) < _MIN_EXPOSURES_POOL:
            return
        mean = np.mean([self.cd[k] for k in active], axis=0)
        b = np.array([np.linalg.solve(mean, self.cd[k]) - np.eye(2) for k in active])
        covariance = np.array([self.covariance[k] for k in active])
        posterior, covariance, self.pooled = pool_linear(b, covariance)
        for k, (shift, matrix), c in zip(active, posterior, covariance):
            self.crval[k] = np.array(deproject(*(self.cd[k] @ shift), self.crval[k]))
            self.cd[k] = mean @ (np.eye(2) + matrix)
            self.covariance[k] = c
            s = self.pairs.slices[k]
            self.residual[:, s] = z[:, s] - self.project_reference(k)

    def _places(self, before):
        """Sky positions of a grid in every exposure, and their largest move, px."""
        ny, nx = self.pairs.image_shape
        x, y = (
            a.ravel() for a in np.meshgrid(np.linspace(0, nx - 1, 9), np.linspace(0, ny - 1, 9))
        )
        z = self.polynomial_positions(x, y)
        if self.table is not None:
            z = z - np.array(self.table(x, y))
        places, moved = {}, 0.0
        for k in self.active:
            places[k] = deproject(*(self.cd[k] @ z), self.crval[k])
            if before is None or k not in before:
                moved = np.inf
                continue
            old = np.linalg.solve(self.cd[k], np.array(project(*before[k], self.crval[k])))
            moved = max(moved, float(np.abs(old - z).max()))
        return places, moved

    def _reject_unconstrained(self):
        """Leave out exposures whose attitude says nothing about the far side of the detector."""
        ny, nx = self.pairs.image_shape
        corners = self._offset(
            np.array([0, nx - 1, 0, nx - 1.0]), np.array([0, 0, ny - 1, ny - 1.0])
        )
        for k in self.active:
            sigma = np.sqrt(attitude_variance(self.covariance[k], corners).max())
            if sigma > _MAX_CORNER_SIGMA:
                n = int(self.kept[self.pairs.slices[k]].sum())
                self.reject(
                    k,
                    f"its {n} stars leave the far corner of the detector uncertain by "
                    f"{sigma:.2g} px",
                )

    def refine(self, refine):
        """Give each exposure a polynomial of its own, the table fixed."""
        if refine == "attitude":
            return
        p = self.pairs
        z = self.polynomial_positions(p.x, p.y)
        table = z - self.apply_table(z)
        if refine == "auto" and not self._own_pv_predicts(table):
            return
        inverse = np.linalg.inv(self.cd0)
        n_terms = len(self.pv.term_indices)
        for k in self.active:
            s = p.slices[k]
            kept = self.kept[s]
            offset = self._offset(p.x[s], p.y[s])
            if np.sum(self.weight(np.hypot(*offset[:, kept])) > 0.5) < 3 * n_terms:
                log.info("exposure %s keeps the shared polynomial", p.exposures[k].name)
                continue
            fitter = WPDCFitter(weight=self.weight, pixel_scale=self.cd0)
            target = self.project_reference(k) + table[:, s]
            pv = fitter(
                PVPolynomial(self.degree),
                *(self.cd0 @ offset[:, kept]),
                *(self.cd0 @ target[:, kept]),
                weights=1.0 / np.sqrt(self.cd0**2 @ self.sigma[:, s][:, kept] ** 2),
            )
            pv, constant, linear = _split_linear(pv)
            # The table stands behind the polynomial: its own linear part is not touched by the
            # gauge.
            self.own_pv[k] = pv, _blocks(fitter.fit_info["covariance"], n_terms)
            matrix = inverse @ linear @ self.cd0
            self.move(k, inverse @ constant, matrix)
            undistorted = self.polynomial_positions(p.x[s], p.y[s], pv) - table[:, s]
            self.residual[:, s] = undistorted - self.project_reference(k)

    def _own_pv_predicts(self, table):
        """Whether own polynomials predict left-out stars better; both fits leave one out."""
        p = self.pairs
        shared = own = 0.0
        for k in self.active:
            s = p.slices[k]
            kept = self.kept[s]
            offset = self._offset(p.x[s], p.y[s])[:, kept]
            radial = self.weight(np.hypot(*offset))
            if np.sum(radial > 0.5) < 3 * len(self.pv.term_indices):
                continue
            a, b = offset / p.half
            terms = pv_terms(self.degree)
            cubic = a[:, None] ** terms.own * b[:, None] ** terms.other
            linear = cubic[:, :3]
            target = self.project_reference(k)[:, kept] + table[:, s][:, kept]
            for axis in range(2):
                inverse_variance = self.sigma[axis, s][kept] ** -2
                press = self.residual[axis, s][kept]
                hat = solve_linear(linear, press, inverse_variance, leverage=True).leverage
                shared += np.sum((press / (1 - hat)) ** 2 * inverse_variance)
                fit = solve_linear(cubic, target[axis], radial * inverse_variance, leverage=True)
                press = (target[axis] - cubic @ fit.parameters) / (1 - fit.leverage)
                own += np.sum(press**2 * inverse_variance)
        log.info("own polynomials: %.6g, shared: %.6g", own, shared)
        return own < shared

    def result(self, detector, settings, stored):
        """Frozen results of the state."""
        p = self.pairs
        fits = []
        for k, e in enumerate(p.exposures):
            s = p.slices[k]
            residual = np.where(p.finite[s], self.residual[:, s], np.nan)
            kept = self.kept[s]
            rejected = self.reason[k] is not None
            pv, covariance = self.own_pv[k] or (None, None)
            fits.append(
                ExposureFit(
                    name=e.name,
                    crval=np.array(e.crval, dtype=float) if rejected else self.crval[k],
                    cd=np.array(e.cd, dtype=float) if rejected else self.cd[k],
                    covariance=self.covariance[k],
                    dx=residual[0],
                    dy=residual[1],
                    x_err=self.sigma[0, s],
                    y_err=self.sigma[1, s],
                    used=kept,
                    pv=pv,
                    pv_covariance=covariance,
                    reason=self.reason[k],
                    statistics={
                        "n_pairs": int(kept.size),
                        "n_used": int(kept.sum()),
                        "scatter_dx": robust_sigma(residual[0][kept]),
                        "scatter_dy": robust_sigma(residual[1][kept]),
                    },
                )
            )
        rejected = {f.name: f.reason for f in fits if f.reason is not None}
        solution = self._solution(detector, settings, stored)
        return InstrumentResult(solution, tuple(fits), rejected, self.table_info)

    def _solution(self, detector, settings, stored):
        statistics = {
            "n_exposures": len(self.active),
            "n_used": int(self.kept.sum()),
            "rounds": self.rounds,
            # One model for pairs with stated errors, one for pairs without (there the scale is the
            # error in px); the first of them by itself, too.
            "error_scale": next(iter(self.error_models.values()))["scale"],
            "error_floor": next(iter(self.error_models.values()))["floor"],
            "error_models": self.error_models,
        }
        if self.pooled:
            statistics["attitude_variation"] = self.pooled
        info = self.table_info
        if info is not None:
            statistics["table"] = asdict(info.choice)
            statistics["table_chi2"] = float(info.chi2)
            statistics["table_candidates"] = [asdict(c) for c in info.candidates]
        if stored is not None:
            if info is None:
                return stored
            for name in ("n_exposures", "n_used"):
                statistics[name] += stored.statistics.get(name, 0)
            return replace(
                stored,
                lookup_table=self.table,
                table_sigma=info.sigma,
                residual_map=self.residual_map,
                statistics={**stored.statistics, **statistics},
            )
        # The mean pointing, as a vector: right ascensions do not average across 0 h.
        ra, dec = np.radians([self.crval[k] for k in self.active]).T
        mean = np.mean([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1)
        crval = np.degrees(
            [np.arctan2(mean[1], mean[0]) % (2 * np.pi), np.arctan2(mean[2], np.hypot(*mean[:2]))]
        )
        return DistortionSolution(
            detector=detector,
            image_shape=self.pairs.image_shape,
            crpix=self.pairs.crpix,
            cd=self.cd0,
            crval=crval,
            pv=self.pv,
            lookup_table=self.table,
            pv_covariance=self.pv_covariance,
            table_sigma=None if info is None else info.sigma,
            residual_map=self.residual_map,
            statistics=statistics,
            settings=settings,
        )


def _blocks(covariance, n):
    return np.array([covariance[:n, :n], covariance[n:, n:]])


def _split_linear(pv):
    """Take constant and linear part out of a polynomial, PV = c + L PV'."""
    terms = pv_terms(pv.degree)
    own, other = pv.coefficients
    # Terms of axis 2 are in (eta, xi): bring both axes to the order of axis 1.
    swap = np.array(
        [
            int(np.flatnonzero((terms.own == b) & (terms.other == a))[0])
            for a, b in zip(terms.own, terms.other)
        ]
    )
    both = np.array([own, other[swap]])
    constant, linear = both[:, 0].copy(), both[:, 1:3].copy()
    both[:, 0] = 0.0
    both = np.linalg.solve(linear, both)
    both[:, 1:3] = np.eye(2)
    return PVPolynomial.from_coefficients([both[0], both[1][swap]], pv.degree), constant, linear
