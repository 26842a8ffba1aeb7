/* Gnomonic projection, after and before a map of the plane. */
#ifndef WPDC_SKY_H
#define WPDC_SKY_H

#include "angles.h"
#include "plane.h"

typedef struct {
    double ra0, sin0, cos0;      /* tangent point */
    double m00, m01, m10, m11;   /* from the plane in degrees ... */
    double x0, y0;               /* ... to pixels, for the inverse */
} Tangent;

typedef struct {
    double x_low, x_high, y_low, y_high, fill;
} Box;

/* The plane in radians to the sky in degrees, in place. */
INLINE void deproject_block(const Tangent *tangent, ptrdiff_t n, double *restrict a,
                            double *restrict b) {
    const Tangent g = *tangent;
    for (ptrdiff_t k = 0; k < n; k++) {
        double xi = a[k], eta = b[k];
        double ahead = eta * -g.sin0 + g.cos0;
        double north = eta * g.cos0 + g.sin0;
        a[k] = wrap(arc_tangent(xi, ahead) + g.ra0);
        b[k] = arc_tangent(north, sqrt(xi * xi + ahead * ahead));
    }
}

/* The sky in degrees to pixels; NaN on the far hemisphere. */
INLINE void project_block(const Tangent *tangent, const double *restrict ra,
                          const double *restrict dec, ptrdiff_t n, double *restrict x,
                          double *restrict y) {
    const Tangent g = *tangent;
    for (ptrdiff_t k = 0; k < n; k++) {
        double sin_ra, cos_ra, sin_dec, cos_dec;
        sin_cos(ra[k] - g.ra0, &sin_ra, &cos_ra);
        sin_cos(dec[k], &sin_dec, &cos_dec);
        double ahead = cos_dec * cos_ra;
        double depth = g.sin0 * sin_dec + g.cos0 * ahead;
        /* The horizon itself is infinitely far away. */
        double scale = depth > 1e-12 ? DEGREE / depth : NAN;
        double xi = cos_dec * sin_ra * scale;
        double eta = (g.cos0 * sin_dec - g.sin0 * ahead) * scale;
        x[k] = g.m00 * xi + g.m01 * eta + g.x0;
        y[k] = g.m10 * xi + g.m11 * eta + g.y0;
    }
}

INLINE int in_box(const Box *box, double x, double y) {
    return (x >= box->x_low) & (x <= box->x_high) & (y >= box->y_low) & (y <= box->y_high);
}

INLINE int all_in_box(const Box *limits, const double *restrict x, const double *restrict y,
                      ptrdiff_t n) {
    const Box box = *limits;
    ptrdiff_t inside = 0;
    for (ptrdiff_t k = 0; k < n; k++) inside += in_box(&box, x[k], y[k]);
    return inside == n;
}

/* Detector to sky.  If there are cells that map to the sky itself (plus RA0), points inside them use
 * these. */
INLINE void to_sky_block(const Plane *plane, const Plane *cells, const Tangent *g, const Box *box,
                         const double *restrict x, const double *restrict y, ptrdiff_t n,
                         double *restrict ra, double *restrict dec) {
    const int boxed = box != NULL && !all_in_box(box, x, y, n);
    if (!cells) {
        plane_block(plane, x, y, n, ra, dec);
        deproject_block(g, n, ra, dec);
    } else {
        const Box edge = {cells->x_low, cells->x_high, cells->y_low, cells->y_high, 0.0};
        cells_block(cells, x, y, n, 0, ra, dec);
        for (ptrdiff_t k = 0; k < n; k++) ra[k] = wrap(ra[k]);
        if (!all_in_box(&edge, x, y, n)) {
            double x_out[BLOCK], y_out[BLOCK], a[BLOCK], b[BLOCK];
            int index[BLOCK], n_out = 0;
            for (ptrdiff_t k = 0; k < n; k++) {
                if (in_box(&edge, x[k], y[k]) || (boxed && !in_box(box, x[k], y[k]))) continue;
                x_out[n_out] = x[k];
                y_out[n_out] = y[k];
                index[n_out++] = (int)k;
            }
            plane_block(plane, x_out, y_out, n_out, a, b);
            deproject_block(g, n_out, a, b);
            for (int k = 0; k < n_out; k++) {
                ra[index[k]] = a[k];
                dec[index[k]] = b[k];
            }
        }
    }
    if (boxed) {
        for (ptrdiff_t k = 0; k < n; k++) {
            /* Written so that NaN counts as outside. */
            int inside = in_box(box, x[k], y[k]);
            ra[k] = inside ? ra[k] : box->fill;
            dec[k] = inside ? dec[k] : box->fill;
        }
    }
}

/* Values of the cells along the rows of an image, a[row][column], for all columns of a tile. */
INLINE void cells_rows(const Plane *p, const double *restrict x, ptrdiff_t n_x,
                       const double *restrict y, ptrdiff_t n_y, ptrdiff_t stride,
                       double *restrict a, double *restrict b) {
    const double x_inverse = 1.0 / p->x_step, y_inverse = 1.0 / p->y_step;
    /* Coefficients of a row of cells, after s has been inserted. */
    double c[4][2][BLOCK], s[BLOCK];
    ptrdiff_t column[BLOCK];
    for (ptrdiff_t k = 0; k < n_x; k++) {
        double i = locate(x[k], p->x_low, x_inverse, (double)p->nx, s + k);
        column[k] = i == i ? (ptrdiff_t)i : 0;
    }
    ptrdiff_t known = -1;
    for (ptrdiff_t row = 0; row < n_y; row++) {
        double t, j = locate(y[row], p->y_low, y_inverse, (double)p->ny, &t);
        ptrdiff_t number = j == j ? (ptrdiff_t)j : 0;
        if (number != known) {
            known = number;
            const double *restrict cells = p->table + 32 * number * (p->nx + 2);
            for (ptrdiff_t k = 0; k < n_x; k++) {
                const double *restrict w = cells + 32 * column[k];
                for (int q = 0; q < 4; q++)
                    for (int o = 0; o < 2; o++, w += 4)
                        c[q][o][k] = ((w[3] * s[k] + w[2]) * s[k] + w[1]) * s[k] + w[0];
            }
        }
        double *restrict a_row = a + row * stride, *restrict b_row = b + row * stride;
        for (ptrdiff_t k = 0; k < n_x; k++)
            a_row[k] = ((c[3][0][k] * t + c[2][0][k]) * t + c[1][0][k]) * t + c[0][0][k];
        for (ptrdiff_t k = 0; k < n_x; k++)
            b_row[k] = ((c[3][1][k] * t + c[2][1][k]) * t + c[1][1][k]) * t + c[0][1][k];
    }
}

#endif
