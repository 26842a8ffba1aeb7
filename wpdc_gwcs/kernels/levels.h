/* Levels of the sky: pixels counted by value within cells, and smooth maps over an image. */
#ifndef WPDC_LEVELS_H
#define WPDC_LEVELS_H

#include <stdint.h>
#include <string.h>

#include "common.h"

/* Number of steps that the values of a cell are counted in; N_STEPS in levels_in_numpy.py. */
#define N_STEPS 256
/* Counters are kept several times, so that equal values in a row need not wait for each other. */
#define COPIES 4

/* Count the pixels of a cell by value: step k holds those from low + k / rate. */
INLINE void count_cell(const float *image, const unsigned char *mask, ptrdiff_t nx, ptrdiff_t top,
                       ptrdiff_t bottom, ptrdiff_t left, ptrdiff_t right, float low, float rate,
                       int32_t *counts) {
    /* The last counter is for values beyond the others, NaN and masked pixels. */
    int32_t counters[COPIES][N_STEPS + 1];
    memset(counters, 0, sizeof counters);
    for (ptrdiff_t y = top; y < bottom; y++)
        for (ptrdiff_t x = left; x < right; x += BLOCK) {
            const ptrdiff_t n = right - x < BLOCK ? right - x : BLOCK;
            const float *value = image + y * nx + x;
            int32_t step[BLOCK];
            for (ptrdiff_t i = 0; i < n; i++) {
                float place = (value[i] - low) * rate;
                place = place >= 0.0f ? place : (float)N_STEPS;
                place = place < (float)N_STEPS ? place : (float)N_STEPS;
                step[i] = (int32_t)place;
            }
            if (mask) {
                const unsigned char *hidden = mask + y * nx + x;
                for (ptrdiff_t i = 0; i < n; i++) step[i] = hidden[i] ? N_STEPS : step[i];
            }
            ptrdiff_t i = 0;
            for (; i + COPIES <= n; i += COPIES)
                for (int c = 0; c < COPIES; c++) counters[c][step[i + c]]++;
            for (; i < n; i++) counters[0][step[i]]++;
        }
    for (int k = 0; k < N_STEPS; k++) {
        int32_t sum = 0;
        for (int c = 0; c < COPIES; c++) sum += counters[c][k];
        counts[k] = sum;
    }
}

/* Write piecewise cubics into a row of an image, or take them off it: four coefficients of each
 * piece, the highest power first, of an offset that every column has. */
INLINE void row_cubics(const float *coefficients, const double *edges, ptrdiff_t n_pieces,
                       const float *offset, int subtract, float *row) {
    for (ptrdiff_t piece = 0; piece < n_pieces; piece++) {
        const float *c = coefficients + 4 * piece;
        const float c0 = c[0], c1 = c[1], c2 = c[2], c3 = c[3];
        const ptrdiff_t first = (ptrdiff_t)edges[piece], last = (ptrdiff_t)edges[piece + 1];
        if (subtract)
            for (ptrdiff_t x = first; x < last; x++) {
                const float t = offset[x];
                row[x] -= ((c0 * t + c1) * t + c2) * t + c3;
            }
        else
            for (ptrdiff_t x = first; x < last; x++) {
                const float t = offset[x];
                row[x] = ((c0 * t + c1) * t + c2) * t + c3;
            }
    }
}

#endif
