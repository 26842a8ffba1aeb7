/* Stars: a point-spread function of cubic B-splines in pixels, and the normal equations of fits.
 *
 * stars_in_numpy.py describes the arguments.  Sums are made in a different order there, so the results
 * agree except for rounding.
 */
#ifndef WPDC_STARS_H
#define WPDC_STARS_H

#include <float.h>

#include "common.h"

typedef struct {
    const double *grids;     /* [component][row][column], zero outside */
    ptrdiff_t n_grids, size; /* number of components; rows and columns of each */
    ptrdiff_t oversampling;
    /* work space: three numbers for each grid column that the pixels of a row span */
    double *line;
} Spline;

INLINE ptrdiff_t columns_of(ptrdiff_t oversampling, ptrdiff_t half) {
    return oversampling * 2 * half + 4;
}

typedef struct {
    double base_x, base_y;           /* knots below the star's central pixel */
    const double *taps_x, *slopes_x; /* weights of knots base - 1 to base + 2, and their slopes */
    const double *taps_y, *slopes_y;
    const double *shares; /* of the components */
} Phase;

/* Add four rows of knots with their weights. */
INLINE void add_rows(const double *const *rows, const double *weight, ptrdiff_t low,
                     ptrdiff_t high, double *restrict line) {
    const double *restrict a = rows[0], *restrict b = rows[1];
    const double *restrict c = rows[2], *restrict d = rows[3];
    const double wa = weight[0], wb = weight[1], wc = weight[2], wd = weight[3];
    for (ptrdiff_t k = low; k < high; k++)
        line[k] += (wa * a[k] + wb * b[k]) + (wc * c[k] + wd * d[k]);
}

/* One row of pixels of a star, from -half to half: values, and derivatives by dx and dy. */
INLINE void star_row(const Spline *spline, const Phase *phase, ptrdiff_t row, ptrdiff_t half,
                     const int gradient, double *restrict value, double *restrict by_x,
                     double *restrict by_y) {
    const ptrdiff_t size = spline->size, step = spline->oversampling;
    const ptrdiff_t width = 2 * half + 1, n = columns_of(step, half);
    double *restrict line = spline->line, *restrict slope = line + n;
    for (ptrdiff_t c = 0; c < n; c++) line[c] = slope[c] = 0.0;
    /* There is no light beyond the grid.  The test also excludes overflow of integers. */
    const double reach = (double)(size + n);
    if (fabs(phase->base_x) < reach && fabs(phase->base_y) < reach) {
        const ptrdiff_t first = (ptrdiff_t)phase->base_x - 1 - step * half;
        const ptrdiff_t low = first < 0 ? -first : 0;
        const ptrdiff_t high = first + n > size ? size - first : n;
        const ptrdiff_t top = (ptrdiff_t)phase->base_y - 1 + step * row;
        for (ptrdiff_t r = 0; r < spline->n_grids; r++) {
            const double *knots[4];
            double weight[4], steep[4];
            for (ptrdiff_t q = 0; q < 4; q++) {
                /* Rows beyond the grid have zero weight; any row can be read instead. */
                const int there = top + q >= 0 && top + q < size;
                knots[q] = spline->grids + (r * size + (there ? top + q : 0)) * size + first;
                weight[q] = there ? phase->shares[r] * phase->taps_y[q] : 0.0;
                steep[q] = there ? phase->shares[r] * phase->slopes_y[q] : 0.0;
            }
            add_rows(knots, weight, low, high, line);
            if (gradient) add_rows(knots, steep, low, high, slope);
        }
    }
    const double *restrict w = phase->taps_x, *restrict d = phase->slopes_x;
    const double scale = -(double)step;
    for (ptrdiff_t j = 0; j < width; j++) {
        const double *restrict l = line + step * j, *restrict m = slope + step * j;
        value[j] = w[0] * l[0] + w[1] * l[1] + w[2] * l[2] + w[3] * l[3];
        if (gradient) {
            by_x[j] = scale * (d[0] * l[0] + d[1] * l[1] + d[2] * l[2] + d[3] * l[3]);
            by_y[j] = scale * (w[0] * m[0] + w[1] * m[1] + w[2] * m[2] + w[3] * m[3]);
        }
    }
}

/* All pixels of one star; all NaN if its position is NaN. */
INLINE void star_pixels(const Spline *spline, const Phase *phase, ptrdiff_t half, int gradient,
                        double *restrict value, double *restrict by_x, double *restrict by_y) {
    const ptrdiff_t width = 2 * half + 1;
    for (ptrdiff_t row = -half; row <= half; row++, value += width) {
        if (gradient) {
            star_row(spline, phase, row, half, 1, value, by_x, by_y);
            by_x += width;
            by_y += width;
        } else {
            star_row(spline, phase, row, half, 0, value, NULL, NULL);
        }
    }
}

/* Add one star to a float32 image. */
INLINE void paint_star(const Spline *spline, const Phase *phase, double x, double y, double flux,
                       ptrdiff_t half, float *restrict image, ptrdiff_t ny, ptrdiff_t nx) {
    double *value = spline->line + 2 * columns_of(spline->oversampling, half);
    if (!(fabs(x) < 1e9 && fabs(y) < 1e9)) return;
    const ptrdiff_t xc = (ptrdiff_t)x, yc = (ptrdiff_t)y;
    const ptrdiff_t low = xc - half < 0 ? half - xc : 0;
    const ptrdiff_t high = xc + half >= nx ? nx - xc + half : 2 * half + 1;
    for (ptrdiff_t row = -half; row <= half; row++) {
        if (yc + row < 0 || yc + row >= ny) continue;
        star_row(spline, phase, row, half, 0, value, NULL, NULL);
        float *restrict line = image + (yc + row) * nx + xc - half;
        for (ptrdiff_t j = low; j < high; j++) line[j] += (float)(flux * value[j]);
    }
}

/* Take the light in the pixels of one star off some rows of an image, and leave no light there: the
 * pixels that stars share are taken off once. */
INLINE void take_star(double x, double y, ptrdiff_t half, ptrdiff_t first, ptrdiff_t last,
                      float *restrict light, float *restrict image, ptrdiff_t ny, ptrdiff_t nx) {
    if (!(fabs(x) < 1e9 && fabs(y) < 1e9)) return;
    const ptrdiff_t xc = (ptrdiff_t)x, yc = (ptrdiff_t)y;
    const ptrdiff_t left = xc - half < 0 ? 0 : xc - half;
    const ptrdiff_t right = xc + half >= nx ? nx : xc + half + 1;
    const ptrdiff_t top = yc - half < 0 ? 0 : yc - half;
    const ptrdiff_t bottom = yc + half >= ny ? ny : yc + half + 1;
    for (ptrdiff_t row = top; row < bottom; row++) {
        float *restrict from = light + row * nx, *restrict to = image + row * nx;
        if (row >= first && row < last)
            for (ptrdiff_t k = left; k < right; k++) to[k] -= from[k];
        for (ptrdiff_t k = left; k < right; k++) from[k] = 0.0f;
    }
}

typedef struct {
    double inverse_gain, mismatch;
} NoiseNumbers;

/* Gauss-Newton step of x, y and flux of one star, its covariance and its reduced chi square. */
INLINE void star_step(const double *restrict value, const double *restrict by_x,
                      const double *restrict by_y, double flux, const double *restrict pixels,
                      const unsigned char *restrict use, const double *restrict variance,
                      const double *restrict photons, NoiseNumbers noise, ptrdiff_t n,
                      double *restrict step, double *restrict covariance, double *chi2) {
    double peak = 0.0;
    for (ptrdiff_t k = 0; k < n; k++) {
        double model = flux * value[k];
        peak = model > peak ? model : peak;
    }
    const double error = noise.mismatch * noise.mismatch * peak;
    double xx = 0, xy = 0, xf = 0, yy = 0, yf = 0, ff = 0, rx = 0, ry = 0, rf = 0, sum = 0;
    ptrdiff_t n_used = 0;
    for (ptrdiff_t k = 0; k < n; k++) {
        if (!use[k]) continue;
        double model = flux * value[k];
        double light = model > 0.0 ? model : 0.0;
        double response = photons ? photons[k] : 1.0;
        double weight = 1.0 / (variance[k] + light * (noise.inverse_gain * response + error));
        double residual = pixels[k] - model;
        double f = value[k], x = flux * by_x[k], y = flux * by_y[k];
        double wx = weight * x, wy = weight * y, wf = weight * f;
        xx += wx * x, xy += wx * y, xf += wx * f, yy += wy * y, yf += wy * f, ff += wf * f;
        rx += wx * residual, ry += wy * residual, rf += wf * residual;
        sum += weight * residual * residual;
        n_used++;
    }
    *chi2 = sum / (double)(n_used > 4 ? n_used - 3 : 1);
    /* Scaled to a unit diagonal, so that "singular" means the same for all fluxes. */
    const double sx = sqrt(xx), sy = sqrt(yy), sf = sqrt(ff);
    const int empty = !(sx > 0.0 && sy > 0.0 && sf > 0.0);
    const double a = xy / sx / sy, b = xf / sx / sf, c = yf / sy / sf;
    const double determinant = 1.0 - a * a - b * b - c * c + 2.0 * a * b * c;
    if (empty || !(determinant > 1e-6)) {
        for (int k = 0; k < 3; k++) step[k] = 0.0;
        for (int k = 0; k < 9; k++) covariance[k] = NAN;
        return;
    }
    covariance[0] = (1.0 - c * c) / determinant / sx / sx;
    covariance[4] = (1.0 - b * b) / determinant / sy / sy;
    covariance[8] = (1.0 - a * a) / determinant / sf / sf;
    covariance[1] = covariance[3] = (b * c - a) / determinant / sx / sy;
    covariance[2] = covariance[6] = (a * c - b) / determinant / sx / sf;
    covariance[5] = covariance[7] = (a * b - c) / determinant / sy / sf;
    for (int k = 0; k < 3; k++)
        step[k] = covariance[3 * k] * rx + covariance[3 * k + 1] * ry + covariance[3 * k + 2] * rf;
}

#endif
