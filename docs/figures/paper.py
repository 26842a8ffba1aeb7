"""Put a reproduction of the paper into its page: its tables, and its figures made small.

    wpdc reproduce all --output reproduced
    python docs/figures/paper.py reproduced

Copies ``results.ecsv`` and writes ``*.csv`` into ``docs/explanation/paper``, and ``paper_*.png``
into ``docs/images``.  Numbers stand nowhere else in the page.
"""

import argparse
import csv
import re
import shutil
from pathlib import Path

import numpy as np
from astropy.table import Table
from PIL import Image

DOCS = Path(__file__).resolve().parent.parent
TABLES = DOCS / "explanation" / "paper"
IMAGES = DOCS / "images"
# Figures of the page, and how wide they may be, px.
FIGURES = (
    ("detectors/focal-plane", 900),
    ("detectors/before-after-g-1-literal", 1210),
    ("detectors/before-after-g-1-ours", 1210),
    ("weights/weights", 1045),
    ("weights/weights-central", 1045),
    ("weights/slices", 1045),
    ("centroids/centroids", 1265),
    ("cluster/residuals-literal", 1265),
    ("cluster/residuals-ours", 1265),
    ("cluster/magnitude-ours", 1045),
    ("bass/sky-offsets-literal", 616),
    ("bass/sky-offsets-cubic", 616),
    ("bass/sky-offsets-ours", 616),
    ("bass/sky-offsets-scamp", 616),
)
# Colors of a figure once it is small.
N_COLORS = 64
WEIGHTS = ("w1", "w2", "w3", "w4", "unweighted")
# Rows of the look-up table that the paper prints: nodes along x at a node along y.
TABLE_1 = ((0, (0, 1, 2, 3)), (24, (30, 31, 32, 33)), (49, (46, 47, 48, 49)))


class Results:
    """Numbers of a reproduction by part, item and quantity."""

    def __init__(self, table):
        self._rows = {(r["part"], r["item"], r["quantity"]): r for r in table}

    def __call__(self, part, item, quantity, column="ours"):
        row = self._rows.get((part, item, quantity))
        return np.nan if row is None else float(row[column])

    def items(self, part, pattern):
        found = dict.fromkeys(item for p, item, _ in self._rows if p == part)
        return [item for item in found if re.fullmatch(pattern, item)]


def text(value, digits):
    """A number as it stands in a table; a dash where there is none."""
    if not np.isfinite(value):
        return "–"
    # No negative zero.
    return re.sub(r"^-(?=[0.]+$)", "", f"{value:.{digits}f}")


def pair(values, digits):
    return " / ".join(text(v, digits) for v in values)


def moments(r, part, item, column, digits, axes=("dx", "dy"), prefix=""):
    return [
        pair([r(part, item, f"{prefix}{name}_{axis}", column) for axis in axes], digits)
        for name in ("mean", "sigma")
    ]


def glance(r):
    """What the package is to show, and what it does."""
    names = r.items("detectors", r"\w+-\d")
    dense = [n for n in names if not n.startswith("NUV")]
    nuv = [n for n in names if n.startswith("NUV")]

    def worst(items, quantity, pick=max):
        return pick(abs(r("detectors", item, quantity)) for item in items)

    mean = max(worst(names, q) for q in ("mean_dx", "mean_dy"))
    rows = [
        ("means of the residuals, all detectors, px", "0.018", "≤ 0.002", text(mean, 5)),
        ("error of the WCS, rms, px: worst detector but NUV", "–", "≤ 0.002",
         text(worst(dense, "wcs_rms"), 4)),
        ("the same, worst NUV", "–", "≤ 0.006", text(worst(nuv, "wcs_rms"), 4)),
        ("area with an error below 0.01 px: worst detector but NUV", "90 %", "100 %",
         f"{100 * worst(dense, 'share_below_0p01', min):.2f} %"),
        ("the same, worst NUV", "90 %", "≥ 95 %",
         f"{100 * worst(nuv, 'share_below_0p01', min):.2f} %"),
    ]  # fmt: skip
    literal = [r("detectors", n, "wcs_rms", "literal") for n in names]
    rows.append(
        ("error of the WCS with the literal method, least and greatest, px", "–",
         "0.138 (46 per arcmin²), 0.109 (5)",
         f"{text(min(literal), 3)} to {text(max(literal), 3)}")
    )  # fmt: skip
    for name, prefix, limit in (("clipped", "", "≤ 0.017"), ("raw", "raw_", "≤ 0.025")):
        rows.append(
            (f"cluster, σ, {name}, px", "0.051 / 0.053" if not prefix else "–", limit,
             pair([r("cluster", "g-1", f"{prefix}sigma_{a}") for a in ("dx", "dy")], 4))
        )  # fmt: skip
    rows.append(
        ("cluster, means, px", "−0.016 / 0.029", "≤ 0.001",
         pair([r("cluster", "g-1", f"mean_{a}") for a in ("dx", "dy")], 4))
    )  # fmt: skip
    headers = r.items("bass", r".*(ccd|CCD)\d")
    cubic = [h for h in headers if r("bass", h, "degree") == 3]
    for name, items, suffix, limit in (
        ("BASS, real cubic headers, cubic alone: worst error of the WCS, mas", cubic, " cubic",
         "≤ 5.5 / 10"),
        ("BASS, all real headers, with the table", headers, "", "≤ 1.5 / 1.5"),
        ("BASS, own distortions, with the table", ["all"], "", "≤ 1.5 / 1.5"),
    ):  # fmt: skip
        if items:
            worst_of = [
                max(r("bass", h + suffix, f"wcs_{a}") for h in items) for a in ("alpha", "delta")
            ]
            rows.append((name, "5.494 / 9.981 (σ)", limit, pair(worst_of, 2)))
    return ("what", "paper", "aim", "here"), rows


def table_2(r):
    rows = []
    for d in r.items("detectors", r"\w+-\d"):
        row = [d]
        for column, digits in (("paper", 3), ("literal", 3), ("ours", 4)):
            row += moments(r, "detectors", d, column, digits)
        rows.append(row)
    columns = ("detector", "paper μ", "paper σ", "literal μ", "literal σ", "default μ", "default σ")
    return columns, rows


def errors(r):
    """What the paper's table cannot have: the error of the WCS itself."""
    rows = []
    for d in r.items("detectors", r"\w+-\d"):
        row = [d, text(r("detectors", d, "largest_distortion"), 0)]
        row += [text(r("detectors", d, "n_stars"), 0)]
        row += [text(r("detectors", d, "wcs_rms", c), n) for c, n in (("literal", 3), ("ours", 4))]
        row += [text(r("detectors", d, "wcs_rms_static"), 4)]
        row += [text(r("detectors", d, "wcs_max", c), n) for c, n in (("literal", 1), ("ours", 3))]
        for quantity in ("share_below_0p01", "share_of_cells_below_0p01"):
            row += [text(100 * r("detectors", d, quantity, c), 1) for c in ("literal", "ours")]
        rows.append(row)
    return (
        ("detector", "distortion, px", "stars", "literal, rms", "default, rms",
         "of it in common", "literal, greatest", "default, greatest",
         "literal, area %", "default, area %", "literal, cells %", "default, cells %"),
        rows,
    )  # fmt: skip


def table_1(folder):
    rows = []
    names = ("literal", "ours")
    read = {n: Table.read(folder / "detectors" / f"table1-g-1-{n}.ecsv") for n in names}
    for j, columns in TABLE_1:
        for i in columns:
            k = 50 * j + i
            at = [text(float(read["literal"][c][k]) + 0.0, 2) for c in ("X_grid", "Y_grid")]
            values = [text(float(read[n][c][k]), 3) for n in names for c in ("dX_LUT", "dY_LUT")]
            rows.append(at + values)
    return ("X_grid", "Y_grid", "ΔX literal", "ΔY literal", "ΔX", "ΔY"), rows


def weights(r):
    rows = []
    for name in WEIGHTS:
        row = [name]
        for item in (name, f"{name} central"):
            for column in ("literal", "ours"):
                row.append(pair([r("weights", item, f"d80_{a}", column) for a in ("dx", "dy")], 3))
                share = r("weights", item, "share_within_0p1", column)
                row.append(text(100 * share, 0))
        rows.append(row)
    return (
        ("weight", "literal d80", "within 0.1 px %", "d80", "%", "literal d80, r < r0", "%",
         "d80, r < r0", "%"),
        rows,
    )  # fmt: skip


def centroids(r):
    rows = []
    for item in r.items("centroids", r"g.*"):
        rows.append(
            [
                item,
                pair([r("centroids", item, f"sigma_{a}", "paper") for a in ("dx", "dy")], 3),
                pair([r("centroids", item, f"sigma_{a}") for a in ("dx", "dy")], 4),
                text(r("centroids", item, "photon_limit"), 4),
                text(r("centroids", item, "n_stars"), 0),
            ]
        )
    return ("stars", "paper σ", "σ", "photon limit", "number"), rows


def cluster(r):
    rows = []
    for name, quantity, digits in (
        ("μ, px", "mean", 4), ("σ after clipping, px", "sigma", 4), ("σ, px", "raw_sigma", 4),
    ):  # fmt: skip
        rows.append(
            [name]
            + [
                pair([r("cluster", "g-1", f"{quantity}_{a}", c) for a in ("dx", "dy")], digits)
                for c in ("paper", "literal", "ours")
            ]
        )
        limit = "photon_limit" if quantity != "raw_sigma" else "raw_photon_limit"
        at = text(r("cluster", "g-1", limit), digits) if quantity != "mean" else "–"
        rows[-1].append(at)
    for item, name in (("g = 19", "σ at g = 19"), ("g = 23.75", "σ at g = 23.75")):
        rows.append(
            [name]
            + [text(r("cluster", item, "sigma_total", c), 3) for c in ("paper", "literal", "ours")]
            + ["–"]
        )
    for quantity, name, digits in (
        ("wcs_rms", "error of the WCS, rms, px", 4), ("n_stars", "stars", 0),
        ("n_wrong", "wrong pairs", 0),
    ):  # fmt: skip
        values = [text(r("cluster", "g-1", quantity, c), digits) for c in ("literal", "ours")]
        rows.append([name, "–", *values, "–"])
    return ("", "paper", "literal", "default", "photon limit"), rows


def bass(r):
    rows = []
    for name, item, column in (
        ("paper, weighted cubic", "all", "paper"), ("paper, SCAMP", "scamp", "paper"),
        ("literal, weighted cubic", "all", "literal"), ("default, cubic alone", "cubic", "ours"),
        ("default", "all", "ours"), ("SCAMP, degree 4", "scamp", "ours"),
    ):  # fmt: skip
        row = [name, *moments(r, "bass", item, column, 3, axes=("alpha", "delta"))]
        # The paper has no truth to hold the WCS against.
        wcs = [r("bass", item, f"wcs_{a}", column) for a in ("alpha", "delta")]
        row += [pair(wcs, 2) if column != "paper" else "–"]
        rows.append([*row, text(r("bass", item, "n_stars", column), 0)])
    return ("", "μ, mas", "σ, mas", "error of the WCS, mas", "stars"), rows


def headers(r):
    rows = []
    for item in r.items("bass", r".*(ccd|CCD)\d"):
        row = [item, text(r("bass", item, "degree"), 0)]
        for name, column in ((f"{item} cubic", "literal"), (f"{item} cubic", "ours"),
                             (item, "ours")):  # fmt: skip
            row.append(pair([r("bass", name, f"wcs_{a}", column) for a in ("alpha", "delta")], 2))
        row.append(pair([r("bass", item, f"sigma_{a}") for a in ("alpha", "delta")], 2))
        rows.append(row)
    return (
        ("header", "degree", "literal cubic", "default, cubic alone", "default",
         "σ of the residuals"),
        rows,
    )  # fmt: skip


def target_of(figure):
    """Name of a figure in the page."""
    return f"paper_{figure.split('/')[1].replace('-', '_')}.png"


def shrink(source, target, width):
    """A figure with few colors, no wider than asked for."""
    with Image.open(source) as image:
        image = image.convert("RGB")
        if image.width > width:
            size = (width, round(image.height * width / image.width))
            image = image.resize(size, Image.Resampling.LANCZOS)
        image.quantize(N_COLORS, dither=Image.Dither.NONE).save(target, optimize=True)


def tables(r):
    """Tables of the page by name, but the look-up table."""
    makers = (glance, table_2, errors, weights, centroids, cluster, bass, headers)
    return {maker.__name__.replace("_", ""): maker(r) for maker in makers}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="what wpdc reproduce all wrote")
    folder = parser.parse_args().folder
    TABLES.mkdir(exist_ok=True)
    shutil.copyfile(folder / "results.ecsv", TABLES / "results.ecsv")
    made = tables(Results(Table.read(folder / "results.ecsv"))) | {"table1": table_1(folder)}
    for name, (columns, rows) in made.items():
        with (TABLES / f"{name}.csv").open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerows([columns, *rows])
    total = 0
    for name, width in FIGURES:
        target = IMAGES / target_of(name)
        # SCAMP may not have been there.
        if (folder / f"{name}.png").exists():
            shrink(folder / f"{name}.png", target, width)
            total += target.stat().st_size
    print(f"{len(made)} tables, figures of {total / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
