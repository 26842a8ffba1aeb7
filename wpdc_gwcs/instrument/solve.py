"""The joint solution: arguments in, frozen results out."""

import numpy as np

from wpdc_gwcs.exceptions import FitError
from wpdc_gwcs.fitting import RadialWeight
from wpdc_gwcs.instrument._pairs import Pairs
from wpdc_gwcs.instrument._solver import Solver

__all__ = ["solve_instrument"]


def solve_instrument(
    exposures,
    *,
    image_shape,
    crpix=None,
    cd=None,
    weight=None,
    degree=3,
    n_grid=50,
    lut="auto",
    refine="attitude",
    solution=None,
    update=False,
    pool_attitudes=True,
    clip=3.5,
    table_choice=None,
    draft=False,
    detector="",
    seed=0,
):
    r"""Solve for the distortion of one detector and the attitude of each of its exposures.

    Parameters
    ----------
    exposures : sequence of Exposure
        Pairs of every exposure.
    image_shape : (int, int)
        Shape ``(ny, nx)`` of the detector.
    crpix : (2,) array_like, optional
        Reference point, px, zero based; the centre of the detector, or that of ``solution``, if not
        given.
    cd : (2, 2) array_like, optional
        Nominal matrix CD0 in which the polynomial stands, deg / px; the mean of the solved ones if
        not given.
    weight : RadialWeight, optional
        Radial weight of the polynomial; ``exp-sqrt`` with 0.87 times half the shorter side if not
        given, and uniform with ``lut="none"``, where no table mends an extrapolation.
    degree : int, optional
        Degree of the PV polynomial.  With fewer than three stars per coefficient inside the weight
        it is lowered.
    n_grid : int, optional
        Nodes of the look-up table along each axis.
    lut : {'auto', 'always', 'none'}, optional
        Whether there is a table; ``auto`` asks the data.
    refine : {'attitude', 'pv', 'auto'}, optional
        What an exposure has of its own: six linear numbers, also a polynomial (the paper's way), or
        whichever predicts left-out stars better.
    solution : DistortionSolution, optional
        Stored instrument: only attitudes are fitted.
    update : bool, optional
        Add the residuals of these exposures to those of ``solution`` and make its table anew.
    pool_attitudes : bool, optional
        Let five or more exposures tell how much scale, rotation and skew really vary between them,
        and draw each exposure's towards their mean accordingly.  No effect where the variation
        exceeds the errors.
    clip : float, optional
        Pairs with residuals of more than this many robust standard deviations are left out.
    table_choice : TableChoice, optional
        Settings of the table, as found before (``result.table_info.choice``), instead of choosing
        them again: for pairs of which only a few have changed.
    draft : bool, optional
        A table of one kernel on large bins, without uncertainty: for matching again, in a small
        part of the time.
    detector : str, optional
        Name of the detector.
    seed : int, optional
        Seed of the division of a single exposure's stars for cross-validation.

    Returns
    -------
    InstrumentResult
        Solution, exposures, and those that were rejected.

    Raises
    ------
    FitError
        If the pairs cannot determine what is asked for; the message names the numbers.
    ValueError
        If an option has a wrong value.

    Notes
    -----
    The undistorted position is :math:`X'' = CD_0^{-1} PV(CD_0 (x - x_0)) + x_0 - \Delta(x)`, and
    :math:`CD_e (X'' - x_0)` is the place on the tangent plane about CRVAL of exposure e.

    1. A smooth surface stands in for the instrument; attitudes and surface alternate, outliers are
       clipped, exposures that do not agree with the others are rejected, and the errors of the
       pairs are rescaled.
    2. The polynomial minimises :math:`\sum w(r_i) \Delta_i^2 / \sigma_i^2` over all exposures.
       Its linear part L, c goes into the attitudes: :math:`CD_e \leftarrow CD_e CD_0^{-1} L CD_0`,
       :math:`PV \leftarrow L^{-1} (PV - c)`, CRVAL moves, and the reference stars are projected
       about the new one.
    3. The table takes what is left (`build_lookup_table`), the attitudes are fitted to all stars,
       and so on until no exposure moves by 1e-4 px anywhere.

    References
    ----------
    WPDC-2P, arXiv:2603.09193, section 3; Bernstein et al. (2017), PASP 129, 074503 (gbdes).

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs.instrument import Exposure, solve_instrument
    >>> from wpdc_gwcs.models import deproject
    >>> cd, centre, rng = np.array([[-2e-5, 0], [0, 2e-5]]), 1023.5, np.random.default_rng(1)
    >>> exposures = []
    >>> for k in range(3):
    ...     x, y = rng.uniform(0, 2047, (2, 500))
    ...     u, v = (x - centre) / 1024, (y - centre) / 1024
    ...     plane = cd @ [x - centre + 3 * u * (u**2 + v**2), y - centre]
    ...     ra, dec = deproject(*plane, (120.0 + 0.01 * k, 30.0))
    ...     exposures.append(Exposure(f"e{k}", x, y, ra, dec, crval=(120.0, 30.0), cd=cd))
    >>> result = solve_instrument(exposures, image_shape=(2048, 2048))
    >>> result.exposures[2].crval
    array([120.02, 30. ])
    """
    if refine not in ("attitude", "pv", "auto"):
        raise ValueError(f"refine must be 'attitude', 'pv' or 'auto', got {refine!r}")
    if lut not in ("auto", "always", "none"):
        raise ValueError(f"lut must be 'auto', 'always' or 'none', got {lut!r}")
    image_shape = tuple(int(n) for n in image_shape)
    exposures = list(exposures)
    if not exposures:
        raise FitError("no exposure was given")
    if solution is not None and tuple(solution.image_shape) != image_shape:
        raise FitError(
            f"the stored solution is for a detector of {tuple(solution.image_shape)} px (ny, "
            "nx), these exposures have "
            f"{image_shape}"
        )
    if update and solution is None:
        raise ValueError("update needs a stored solution")
    if solution is not None:
        crpix, cd = solution.crpix, solution.cd
    if crpix is None:
        crpix = 0.5 * (np.array(image_shape[::-1]) - 1.0)
    crpix = np.array(crpix, dtype=float)
    if weight is None:
        name = "uniform" if lut == "none" else "exp-sqrt"
        weight = RadialWeight.for_shape(image_shape, name)

    pairs = Pairs(exposures, image_shape, crpix)
    settings = {
        "weight": weight.name, "r0": float(weight.r0), "degree": int(degree),
        "n_grid": int(n_grid), "lut": lut, "refine": refine,
        "clip": float(clip), "pool_attitudes": bool(pool_attitudes),
    }  # fmt: skip
    solver = Solver(pairs, weight, clip, pool=pool_attitudes, seed=seed)
    if solution is None:
        solver.align()
        solver.solve(cd, degree, n_grid, lut, choice=table_choice, draft=draft)
    else:
        solver.attach(solution)
        if update:
            solver.update(solution, n_grid, choice=table_choice, draft=draft)
    solver.refine(refine)
    return solver.result(detector, settings, solution)
