/* Cells of an image in which it rises above its noise once it is smoothed. */
#ifndef WPDC_PEAKS_H
#define WPDC_PEAKS_H

#include <stdint.h>
#include <string.h>

#include "common.h"

/* One row of an image between `half` zeros on each side, without its masked pixels; all zeros where
 * the row is outside. */
INLINE void clean_row(const float *image, const unsigned char *mask, ptrdiff_t ny, ptrdiff_t nx,
                      ptrdiff_t y, float *restrict row) {
    if (y < 0 || y >= ny) {
        memset(row, 0, (size_t)nx * sizeof(float));
    } else if (!mask) {
        memcpy(row, image + y * nx, (size_t)nx * sizeof(float));
    } else {
        const float *restrict value = image + y * nx;
        const unsigned char *restrict hidden = mask + y * nx;
        for (ptrdiff_t x = 0; x < nx; x++) row[x] = hidden[x] ? 0.0f : value[x];
    }
}

/* Filter a row with rows above and below it, row[k - half] to row[k + half]. */
INLINE void filter_rows(const float *const *rows, const float *line, ptrdiff_t half, ptrdiff_t nx,
                        float *restrict result) {
    const float *restrict middle = rows[half];
    const float weight = line[half];
    for (ptrdiff_t x = 0; x < nx; x++) result[x] = weight * middle[x];
    for (ptrdiff_t k = 0; k < half; k++) {
        const float *restrict above = rows[k], *restrict below = rows[2 * half - k];
        const float w = line[k];
        for (ptrdiff_t x = 0; x < nx; x++) result[x] += (above[x] + below[x]) * w;
    }
}

/* Mark the cells in which a row, filtered along it, is higher than so many standard deviations. */
INLINE void mark_row(const float *row, const float *line, ptrdiff_t half, const float *rms,
                     float factor, ptrdiff_t nx, ptrdiff_t size, unsigned char *cells) {
    for (ptrdiff_t first = 0, cell = 0; first < nx; first += size, cell++) {
        const ptrdiff_t last = first + size < nx ? first + size : nx;
        int32_t any = 0;
        for (ptrdiff_t start = first; start < last; start += BLOCK) {
            const ptrdiff_t n = last - start < BLOCK ? last - start : BLOCK;
            const float *middle = row + start, *noise = rms + start;
            float value[BLOCK];
            for (ptrdiff_t i = 0; i < n; i++) value[i] = line[half] * middle[i];
            for (ptrdiff_t k = 0; k < half; k++) {
                const float *left = middle - half + k, *right = middle + half - k;
                const float w = line[k];
                for (ptrdiff_t i = 0; i < n; i++) value[i] += (left[i] + right[i]) * w;
            }
            for (ptrdiff_t i = 0; i < n; i++) any |= value[i] > factor * noise[i];
        }
        cells[cell] |= any != 0;
    }
}

/* Mark the cells in some rows of cells; `work` has room for 2 half + 2 rows with their zeros. */
INLINE void mark_cells_between(const float *image, const float *rms, const unsigned char *mask,
                               ptrdiff_t ny, ptrdiff_t nx, const float *line, ptrdiff_t half,
                               float factor, ptrdiff_t size, ptrdiff_t first, ptrdiff_t last,
                               float *work, const float **rows, unsigned char *cells) {
    const ptrdiff_t n = 2 * half + 1, width = nx + 2 * half, n_cells = (nx + size - 1) / size;
    const ptrdiff_t top = first * size, bottom = last * size < ny ? last * size : ny;
    float *smooth = work + n * width;
    memset(work, 0, (size_t)((n + 1) * width) * sizeof(float));
    /* Row y is kept in place y modulo n. */
    for (ptrdiff_t y = top - half; y < top + half; y++)
        clean_row(image, mask, ny, nx, y, work + (y + n) % n * width + half);
    for (ptrdiff_t y = top; y < bottom; y++) {
        clean_row(image, mask, ny, nx, y + half, work + (y + half) % n * width + half);
        for (ptrdiff_t k = 0; k < n; k++) rows[k] = work + (y - half + k + n) % n * width + half;
        filter_rows(rows, line, half, nx, smooth + half);
        mark_row(smooth + half, line, half, rms + y * nx, factor, nx, size,
                 cells + y / size * n_cells);
    }
}

#endif
