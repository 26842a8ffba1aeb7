"""Draw the pictures of docs/tutorial/index.rst from the code that the page shows.

python docs/figures/tutorial.py docs/images
"""

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from wpdc_gwcs import Settings, calibrate, plot_residual_arrows, read_catalog, simulate
from wpdc_gwcs.pictures import draw_solution

SHAPE = (1024, 1024)


def error_arrows(exposure, wcs, title):
    """Error of a WCS over the detector."""
    x, y, dx, dy = (np.ravel(c) for c in exposure.wcs_error(wcs))
    return plot_residual_arrows(x, y, dx, dy, image_shape=SHAPE, title=title, n_bins=16)


def draw_image(image):
    figure = Figure(figsize=(5.2, 4.8), layout="constrained")
    panel = figure.subplots()
    low, high = np.percentile(image, [20, 99.5])
    panel.imshow(image, cmap="gray_r", vmin=low, vmax=high, origin="lower")
    panel.set(xlabel="x [px]", ylabel="y [px]")
    panel.set_title("the first exposure", loc="left", fontsize=10)
    return figure


def main(folder):
    options = {"image_shape": SHAPE, "distortion": 15, "density": 25, "seed": 7}
    simulation = simulate(3, **options)
    exposure = simulation.exposures[0]
    catalog = read_catalog(simulation.reference)
    run = calibrate([e.frame() for e in simulation.exposures], catalog)
    calibration, solution = run.calibrations[0], run.solutions["sim"]
    tonight = simulate(4, **options).exposures[3]
    settings = Settings(refine="attitude")
    again = calibrate(tonight.frame(), catalog, solution=solution, settings=settings)
    used = calibration.matches[calibration.matches["used"]]
    residuals = (np.asarray(used[name], float) for name in ("x", "y", "dx", "dy"))
    pictures = {
        "exposure": draw_image(exposure.frame(image=True).load_image()),
        "header": error_arrows(exposure, exposure.wcs, "error of the header's WCS"),
        "calibrated": error_arrows(exposure, calibration.wcs, "error of the calibrated WCS"),
        "solution": draw_solution(solution),
        "residuals": plot_residual_arrows(
            *residuals, image_shape=SHAPE, n_bins=12, title="mean residuals"
        ),
        "tonight": error_arrows(tonight, again.calibrations[0].wcs, "error of the next night"),
    }
    for name, figure in pictures.items():
        figure.savefig(folder / f"tutorial_{name}.png", dpi=80)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
