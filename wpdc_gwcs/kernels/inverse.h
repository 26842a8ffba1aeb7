/* The inverse of a map of the plane by Newton's method, after an optional gnomonic projection. */
#ifndef WPDC_INVERSE_H
#define WPDC_INVERSE_H

#include <float.h>

#include "sky.h"

#define MAX_NEWTON 25

typedef struct {
    const Plane *plane;
    const Plane *start; /* approximate inverse; NULL: the given points themselves */
    const Tangent *sky; /* NULL: points of the plane are given, not of the sky */
    const Box *box;     /* NULL: results anywhere */
    double rim;         /* results this close to the box are moved to its edge */
    double tolerance;   /* greatest residual */
    double curvature;   /* bound of the second derivatives inside the cells */
    double sign;        /* of the Jacobian determinant in the middle */
} Inverse;

INLINE double hold(double v, double low, double high) {
    v = v < low ? low : v;
    return v > high ? high : v;
}

/* Newton's method for n points, starting at x, y; points without a solution stay NaN. */
INLINE void solve_block(const Inverse *inverse, const double *a_given, const double *b_given,
                        const double *x_start, const double *y_start, const int *given, int n,
                        int bounded, double *x_out, double *y_out) {
    const Plane *plane = inverse->plane;
    const double margin = plane->x_step > plane->y_step ? plane->x_step : plane->y_step;
    const double x_low = plane->x_low - margin, x_high = plane->x_high + margin;
    const double y_low = plane->y_low - margin, y_high = plane->y_high + margin;
    double a[BLOCK], b[BLOCK], x[BLOCK], y[BLOCK], x_new[BLOCK], y_new[BLOCK], values[6][BLOCK];
    double determinant[BLOCK], residual[BLOCK], x_open[BLOCK], y_open[BLOCK];
    int index[BLOCK], open[BLOCK];
    double *const outputs[6] = {values[0], values[1], values[2], values[3], values[4], values[5]};
    for (int k = 0; k < n; k++) {
        index[k] = given[k];
        a[k] = a_given[given[k]];
        b[k] = b_given[given[k]];
        x[k] = x_start[given[k]];
        y[k] = y_start[given[k]];
    }
    for (int round = 0; round < MAX_NEWTON && n > 0; round++) {
        jacobian_block(plane, x, y, n, outputs);
        for (int k = 0; k < n; k++) {
            double left_a = a[k] - values[0][k], left_b = b[k] - values[1][k];
            double det = values[2][k] * values[5][k] - values[3][k] * values[4][k];
            double dx = (values[5][k] * left_a - values[3][k] * left_b) / det;
            double dy = (values[2][k] * left_b - values[4][k] * left_a) / det;
            x_new[k] = x[k] + dx;
            y_new[k] = y[k] + dy;
            determinant[k] = det * inverse->sign;
            /* The length of the step bounds the residual that it leaves. */
            residual[k] = (dx * dx + dy * dy) * (0.5 * inverse->curvature);
        }
        int n_open = 0;
        for (int k = 0; k < n; k++) {
            open[n_open] = k;
            n_open += !((residual[k] <= inverse->tolerance) & in_cells(plane, x_new[k], y_new[k]));
        }
        if (n_open) {
            /* The bound is too large, so evaluate the map itself. */
            for (int k = 0; k < n_open; k++) {
                x_open[k] = x_new[open[k]];
                y_open[k] = y_new[open[k]];
                if (bounded) {
                    x_open[k] = x_new[open[k]] = hold(x_open[k], x_low, x_high);
                    y_open[k] = y_new[open[k]] = hold(y_open[k], y_low, y_high);
                }
            }
            plane_block(plane, x_open, y_open, n_open, values[0], values[1]);
            for (int k = 0; k < n_open; k++) {
                double left_a = fabs(a[open[k]] - values[0][k]);
                double left_b = fabs(b[open[k]] - values[1][k]);
                double greater = left_a < left_b ? left_b : left_a;
                residual[open[k]] = isnan(left_b) ? left_b : greater;
            }
        }
        int n_left = 0;
        for (int k = 0; k < n; k++) {
            double size_a = fabs(a[k]), size_b = fabs(b[k]);
            /* Rounding errors of the map are the lower limit. */
            double limit = inverse->tolerance +
                           16.0 * DBL_EPSILON * (size_a < size_b ? size_b : size_a);
            if (residual[k] <= limit) {
                if (determinant[k] > 0.0) {
                    x_out[index[k]] = x_new[k];
                    y_out[index[k]] = y_new[k];
                }
                continue;
            }
            /* A point that no longer moves, or has gone to infinity, has no solution. */
            if ((x_new[k] == x[k] && y_new[k] == y[k]) || !isfinite(x_new[k]) ||
                !isfinite(y_new[k]))
                continue;
            a[n_left] = a[k];
            b[n_left] = b[k];
            x[n_left] = x_new[k];
            y[n_left] = y_new[k];
            index[n_left++] = index[k];
        }
        n = n_left;
    }
}

INLINE void invert_block(const Inverse *inverse, const double *restrict a_given,
                         const double *restrict b_given, ptrdiff_t n, double *restrict x,
                         double *restrict y) {
    const Plane *plane = inverse->plane, *start = inverse->start;
    double a[BLOCK], b[BLOCK], x_start[BLOCK], y_start[BLOCK], a_held[BLOCK], b_held[BLOCK];
    int index[BLOCK], n_good = 0;
    if (inverse->sky) {
        project_block(inverse->sky, a_given, b_given, n, a, b);
    } else {
        for (ptrdiff_t k = 0; k < n; k++) {
            a[k] = a_given[k];
            b[k] = b_given[k];
        }
    }
    for (ptrdiff_t k = 0; k < n; k++) {
        x[k] = y[k] = NAN;
        x_start[k] = a[k];
        y_start[k] = b[k];
        index[n_good] = (int)k;
        n_good += (isfinite(a[k]) != 0) & (isfinite(b[k]) != 0);
    }
    if (start && start->table) {
        /* Clipped to the edge: points farther out have no solution anyway. */
        for (ptrdiff_t k = 0; k < n; k++) {
            a_held[k] = hold(a[k], start->x_low, start->x_high);
            b_held[k] = hold(b[k], start->y_low, start->y_high);
        }
        plane_block(start, a_held, b_held, n, x_start, y_start);
    } else if (start) {
        plane_block(start, a, b, n, x_start, y_start);
    }
    if (plane->table) {
        const double margin = plane->x_step > plane->y_step ? plane->x_step : plane->y_step;
        for (ptrdiff_t k = 0; k < n; k++) {
            x_start[k] = hold(x_start[k], plane->x_low - margin, plane->x_high + margin);
            y_start[k] = hold(y_start[k], plane->y_low - margin, plane->y_high + margin);
        }
        solve_block(inverse, a, b, x_start, y_start, index, n_good, 1, x, y);
        int n_far = 0;
        for (int k = 0; k < n_good; k++) {
            index[n_far] = index[k];
            n_far += isnan(x[index[k]]) != 0;
        }
        n_good = n_far;
    }
    if (n_good) solve_block(inverse, a, b, x_start, y_start, index, n_good, 0, x, y);
    if (inverse->box) {
        const Box *box = inverse->box;
        for (ptrdiff_t k = 0; k < n; k++) {
            double x_near = hold(x[k], box->x_low, box->x_high);
            double y_near = hold(y[k], box->y_low, box->y_high);
            double x_held = fabs(x_near - x[k]) <= inverse->rim ? x_near : x[k];
            double y_held = fabs(y_near - y[k]) <= inverse->rim ? y_near : y[k];
            int inside = in_box(box, x_held, y_held);
            x[k] = inside ? x_held : box->fill;
            y[k] = inside ? y_held : box->fill;
        }
    }
}

#endif
