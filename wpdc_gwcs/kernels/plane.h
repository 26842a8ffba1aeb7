/* A map of the plane: polynomial, radial terms and bicubic cells, summed.  See plane.py. */
#ifndef WPDC_PLANE_H
#define WPDC_PLANE_H

#include "common.h"

typedef struct {
    /* cells; none if the table is NULL */
    const double *table; /* [cell along y][cell along x][power of t][output][power of s] */
    ptrdiff_t nx, ny;    /* not counting the outer cells */
    double x_low, x_high, x_step, y_low, y_high, y_step;
    /* polynomial; none if NULL */
    const double *polynomial; /* [a, b, a_x, a_y, b_x, b_y][power of u][power of v] */
    ptrdiff_t n;
    double x0, y0;
    /* radial terms; none if NULL */
    const double *radial; /* [a, b, a', b'][power of r] */
    ptrdiff_t n_radial;
    double m00, m01, m10, m11;
} Plane;

INLINE int in_cells(const Plane *p, double x, double y) {
    return (x >= p->x_low) & (x <= p->x_high) & (y >= p->y_low) & (y <= p->y_high);
}

/* Number of the cell along one axis, 0 for the outer one, and the local coordinate in it. */
INLINE double locate(double x, double low, double inverse, double n, double *local) {
    double s = (x - low) * inverse;
    /* Points farther out belong to the outer cells; NaN stays NaN. */
    double held = s < -1.0 ? -1.0 : s;
    held = held > n ? n : held;
    double number = round_even(held);
    number -= number > held ? 1.0 : 0.0;
    *local = s - number;
    return number + 1.0;
}

INLINE void locate_block(const Plane *plane, const double *restrict x, const double *restrict y,
                         ptrdiff_t n, double *restrict cell, double *restrict s,
                         double *restrict t) {
    const Plane p = *plane; /* a copy that no store can alias */
    const double x_inverse = 1.0 / p.x_step, y_inverse = 1.0 / p.y_step;
    const double nx = (double)p.nx, ny = (double)p.ny, width = (double)(p.nx + 2);
    for (ptrdiff_t k = 0; k < n; k++) {
        double i = locate(x[k], p.x_low, x_inverse, nx, s + k);
        double j = locate(y[k], p.y_low, y_inverse, ny, t + k);
        double number = j * width + i;
        /* NaN is in no cell, but any will do: its local coordinate is NaN. */
        cell[k] = number >= 0.0 ? number : 0.0;
    }
}

/* The last step from rows of coefficients of s, [output][power], to values. */
INLINE void cells_finish(double (*restrict rows)[8], const double *restrict s, ptrdiff_t n,
                         const int add, double *restrict a, double *restrict b) {
    for (ptrdiff_t k = 0; k < n; k++) {
        const double *restrict w = rows[k];
        double first = ((w[3] * s[k] + w[2]) * s[k] + w[1]) * s[k] + w[0];
        double second = ((w[7] * s[k] + w[6]) * s[k] + w[5]) * s[k] + w[4];
        a[k] = add ? first + a[k] : first;
        b[k] = add ? second + b[k] : second;
    }
}

/* The same with derivatives: value, by_x, by_y of one output. */
INLINE void jacobian_finish(double (*restrict rows)[16], const double *restrict s, ptrdiff_t n,
                            const int output, const int add, double x_inverse, double y_inverse,
                            double *restrict value, double *restrict by_x, double *restrict by_y) {
    for (ptrdiff_t k = 0; k < n; k++) {
        const double *restrict w = rows[k] + 4 * output, *restrict d = w + 8;
        double total = w[3] * s[k] + w[2];
        double slope = w[3] * s[k] + total;
        total = total * s[k] + w[1];
        slope = slope * s[k] + total;
        double first = total * s[k] + w[0], second = slope * x_inverse;
        double third = (((d[3] * s[k] + d[2]) * s[k] + d[1]) * s[k] + d[0]) * y_inverse;
        value[k] = add ? first + value[k] : first;
        by_x[k] = add ? second + by_x[k] : second;
        by_y[k] = add ? third + by_y[k] : third;
    }
}

/* Values of the cells, either added to a and b or stored there. */
INLINE void cells_block(const Plane *p, const double *restrict x, const double *restrict y,
                        ptrdiff_t n, int add, double *restrict a, double *restrict b) {
    double cell[BLOCK], s[BLOCK], t[BLOCK], rows[BLOCK][8];
    const double *restrict table = p->table;
    locate_block(p, x, y, n, cell, s, t);
    for (ptrdiff_t k = 0; k < n; k++) {
        const double *restrict c = table + 32 * (ptrdiff_t)cell[k];
        const double tk = t[k];
        double *restrict w = rows[k];
        for (int j = 0; j < 8; j++)
            w[j] = ((c[24 + j] * tk + c[16 + j]) * tk + c[8 + j]) * tk + c[j];
    }
    if (add)
        cells_finish(rows, s, n, 1, a, b);
    else
        cells_finish(rows, s, n, 0, a, b);
}

/* One polynomial of the plane by Horner's rule, for LANES points at a time. */
INLINE void horner(const double *restrict c, ptrdiff_t n, const double *restrict u,
                   const double *restrict v, double *restrict total) {
    for (int k = 0; k < LANES; k++) total[k] = c[(n - 1) * n];
    for (ptrdiff_t p = n - 2; p >= 0; p--) {
        const double *restrict row = c + p * n;
        double inner[LANES];
        for (int k = 0; k < LANES; k++) inner[k] = row[n - 1 - p];
        for (ptrdiff_t q = n - 2 - p; q >= 0; q--)
            for (int k = 0; k < LANES; k++) inner[k] = inner[k] * v[k] + row[q];
        for (int k = 0; k < LANES; k++) total[k] = total[k] * u[k] + inner[k];
    }
}

/* All outputs of polynomial and radial terms: two values, optionally with four derivatives. */
INLINE void polynomial_block(const Plane *p, const double *restrict x, const double *restrict y,
                             ptrdiff_t n, int n_outputs, double *const *outputs) {
    for (ptrdiff_t start = 0; start < n; start += LANES) {
        double u[LANES], v[LANES], total[6][LANES];
        const int lanes = n - start < LANES ? (int)(n - start) : LANES;
        for (int k = 0; k < LANES; k++) {
            /* If there are too few points, the first of them fills the other lanes. */
            ptrdiff_t at = k < lanes ? start + k : start;
            u[k] = x[at] - p->x0;
            v[k] = y[at] - p->y0;
        }
        for (int o = 0; o < n_outputs; o++)
            horner(p->polynomial + o * p->n * p->n, p->n, u, v, total[o]);
        if (p->radial) {
            for (int k = 0; k < LANES; k++) {
                double first = p->m00 * u[k] + p->m01 * v[k];
                double second = p->m10 * u[k] + p->m11 * v[k];
                double r = sqrt(first * first + second * second);
                double terms[4];
                for (int o = 0; o < (n_outputs == 2 ? 2 : 4); o++) {
                    const double *restrict c = p->radial + o * p->n_radial;
                    terms[o] = c[p->n_radial - 1];
                    for (ptrdiff_t q = p->n_radial - 2; q >= 0; q--) terms[o] = terms[o] * r + c[q];
                }
                total[0][k] += terms[0];
                total[1][k] += terms[1];
                if (n_outputs > 2) {
                    /* r has no derivative at 0, where its one-sided slopes average to zero. */
                    double inverse = r > 0.0 ? 1.0 / r : 0.0;
                    double r_x = (first * p->m00 + second * p->m10) * inverse;
                    double r_y = (first * p->m01 + second * p->m11) * inverse;
                    total[2][k] += terms[2] * r_x;
                    total[3][k] += terms[2] * r_y;
                    total[4][k] += terms[3] * r_x;
                    total[5][k] += terms[3] * r_y;
                }
            }
        }
        for (int o = 0; o < n_outputs; o++)
            for (int k = 0; k < lanes; k++) outputs[o][start + k] = total[o][k];
    }
}

INLINE void plane_block(const Plane *p, const double *restrict x, const double *restrict y,
                        ptrdiff_t n, double *restrict a, double *restrict b) {
    if (p->polynomial) {
        double *outputs[2] = {a, b};
        polynomial_block(p, x, y, n, 2, outputs);
    }
    if (p->table) cells_block(p, x, y, n, p->polynomial != NULL, a, b);
}

/* Values and derivatives: a, b, a_x, a_y, b_x, b_y. */
INLINE void jacobian_block(const Plane *p, const double *restrict x, const double *restrict y,
                           ptrdiff_t n, double *const *outputs) {
    if (p->polynomial) polynomial_block(p, x, y, n, 6, outputs);
    if (!p->table) return;
    double cell[BLOCK], s[BLOCK], t[BLOCK], rows[BLOCK][16];
    const double *restrict table = p->table;
    locate_block(p, x, y, n, cell, s, t);
    for (ptrdiff_t k = 0; k < n; k++) {
        const double *restrict c = table + 32 * (ptrdiff_t)cell[k];
        const double tk = t[k];
        double *restrict w = rows[k];
        for (int j = 0; j < 8; j++) {
            double total = c[24 + j] * tk + c[16 + j];
            double slope = c[24 + j] * tk + total;
            total = total * tk + c[8 + j];
            slope = slope * tk + total;
            w[j] = total * tk + c[j];
            w[8 + j] = slope;
        }
    }
    const double x_inverse = 1.0 / p->x_step, y_inverse = 1.0 / p->y_step;
    for (int o = 0; o < 2; o++) {
        double *value = outputs[o], *by_x = outputs[2 + 2 * o], *by_y = outputs[3 + 2 * o];
        if (p->polynomial)
            jacobian_finish(rows, s, n, o, 1, x_inverse, y_inverse, value, by_x, by_y);
        else
            jacobian_finish(rows, s, n, o, 0, x_inverse, y_inverse, value, by_x, by_y);
    }
}

#endif
