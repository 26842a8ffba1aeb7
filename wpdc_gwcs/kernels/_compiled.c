/* The kernels as a Python module: check arguments, release the interpreter lock, process blocks.
 *
 * Only the stable ABI and the buffer protocol are used, so one build works with all later versions of
 * Python and NumPy.  Callers pass contiguous arrays of the right sizes (wpdc_gwcs/kernels/plane.py,
 * wpdc_gwcs/models/blocks.py).  Types and sizes are checked here nevertheless, because a wrong one
 * would crash the program.
 */
#define Py_LIMITED_API 0x030B0000
#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <stdlib.h>

#include "inverse.h"
#include "levels.h"
#include "peaks.h"
#include "sky.h"
#include "stars.h"

/* ---- the loops ------------------------------------------------------------------------------ */

#define EACH_BLOCK(start, size, n)                                    \
    for (ptrdiff_t start = 0, n; start < size; start += BLOCK)        \
        if ((n = size - start < BLOCK ? size - start : BLOCK), 1)

FOR_ANY_PROCESSOR
static void run_evaluate(const Plane *plane, const double *x, const double *y, ptrdiff_t size,
                         double *a, double *b) {
    EACH_BLOCK(k, size, n) plane_block(plane, x + k, y + k, n, a + k, b + k);
}

FOR_ANY_PROCESSOR
static void run_jacobian(const Plane *plane, const double *x, const double *y, ptrdiff_t size,
                         double *const *outputs) {
    EACH_BLOCK(k, size, n) {
        double *const parts[6] = {outputs[0] + k, outputs[1] + k, outputs[2] + k,
                                  outputs[3] + k, outputs[4] + k, outputs[5] + k};
        jacobian_block(plane, x + k, y + k, n, parts);
    }
}

FOR_ANY_PROCESSOR
static void run_to_sky(const Plane *plane, const Plane *cells, const Tangent *tangent,
                       const Box *box, const double *x, const double *y, ptrdiff_t size, double *ra,
                       double *dec) {
    EACH_BLOCK(k, size, n)
        to_sky_block(plane, cells, tangent, box, x + k, y + k, n, ra + k, dec + k);
}

FOR_ANY_PROCESSOR
static void run_rows(const Plane *plane, const Plane *cells, const Tangent *tangent,
                     const double *x, ptrdiff_t n_x, const double *y, ptrdiff_t n_y, double *ra,
                     double *dec) {
    const Plane *used = cells ? cells : plane;
    EACH_BLOCK(k, n_x, n) {
        double row_y[BLOCK];
        if (!used->polynomial) cells_rows(used, x + k, n, y, n_y, n_x, ra + k, dec + k);
        for (ptrdiff_t row = 0; row < n_y; row++) {
            double *a = ra + row * n_x + k, *b = dec + row * n_x + k;
            if (used->polynomial) {
                for (ptrdiff_t i = 0; i < n; i++) row_y[i] = y[row];
                plane_block(used, x + k, row_y, n, a, b);
            }
            if (cells)
                for (ptrdiff_t i = 0; i < n; i++) a[i] = wrap(a[i]);
            else
                deproject_block(tangent, n, a, b);
        }
    }
}

FOR_ANY_PROCESSOR
static void run_project(const Tangent *tangent, const double *ra, const double *dec,
                        ptrdiff_t size, double *x, double *y) {
    EACH_BLOCK(k, size, n) project_block(tangent, ra + k, dec + k, n, x + k, y + k);
}

FOR_ANY_PROCESSOR
static void run_invert(const Inverse *inverse, const double *a, const double *b, ptrdiff_t size,
                       double *x, double *y) {
    EACH_BLOCK(k, size, n) invert_block(inverse, a + k, b + k, n, x + k, y + k);
}

#define N_PHASE 18

INLINE Phase phase_of(const double *phases, const double *shares, ptrdiff_t n_shares,
                      ptrdiff_t star) {
    const double *p = phases + N_PHASE * star;
    const Phase phase = {p[0],  p[9],   p + 1,  p + 5,
                         p + 10, p + 14, shares + n_shares * star};
    return phase;
}

FOR_ANY_PROCESSOR
static void run_profiles(const Spline *spline, const double *phases, const double *shares,
                         ptrdiff_t half, ptrdiff_t size, int gradient, double *profiles) {
    const ptrdiff_t n = (2 * half + 1) * (2 * half + 1);
    for (ptrdiff_t k = 0; k < size; k++) {
        const Phase phase = phase_of(phases, shares, spline->n_grids, k);
        double *value = profiles + k * n, *by_x = NULL, *by_y = NULL;
        if (gradient) by_x = value + size * n, by_y = by_x + size * n;
        star_pixels(spline, &phase, half, gradient, value, by_x, by_y);
    }
}

FOR_ANY_PROCESSOR
static void run_paint(const Spline *spline, const double *phases, const double *shares,
                      ptrdiff_t half, const double *centers, const double *flux, ptrdiff_t size,
                      float *image, ptrdiff_t ny, ptrdiff_t nx) {
    for (ptrdiff_t k = 0; k < size; k++) {
        const Phase phase = phase_of(phases, shares, spline->n_grids, k);
        paint_star(spline, &phase, centers[2 * k], centers[2 * k + 1], flux[k], half, image, ny,
                   nx);
    }
}

FOR_ANY_PROCESSOR
static void run_steps(const double *profiles, const double *flux, const double *pixels,
                      const unsigned char *use, const double *variance, const double *photons,
                      NoiseNumbers noise, ptrdiff_t size, ptrdiff_t n, double *step,
                      double *covariance, double *chi2) {
    for (ptrdiff_t k = 0; k < size; k++) {
        const double *value = profiles + k * n, *by_x = value + size * n, *by_y = by_x + size * n;
        star_step(value, by_x, by_y, flux[k], pixels + k * n, use + k * n, variance + k * n,
                  photons ? photons + k * n : NULL, noise, n, step + 3 * k, covariance + 9 * k,
                  chi2 + k);
    }
}

FOR_ANY_PROCESSOR
static void run_take(const double *centers, ptrdiff_t n_stars, ptrdiff_t half, ptrdiff_t first,
                     ptrdiff_t last, float *light, float *image, ptrdiff_t ny, ptrdiff_t nx) {
    for (ptrdiff_t k = 0; k < n_stars; k++)
        take_star(centers[2 * k], centers[2 * k + 1], half, first, last, light, image, ny, nx);
}

FOR_ANY_PROCESSOR
static void run_count(const float *image, const unsigned char *mask, ptrdiff_t nx,
                      const double *rows, ptrdiff_t n_rows, const double *columns,
                      ptrdiff_t n_columns, const float *low, const float *rate, int32_t *counts) {
    for (ptrdiff_t j = 0; j < n_rows; j++)
        for (ptrdiff_t i = 0; i < n_columns; i++) {
            const ptrdiff_t k = j * n_columns + i;
            count_cell(image, mask, nx, (ptrdiff_t)rows[j], (ptrdiff_t)rows[j + 1],
                       (ptrdiff_t)columns[i], (ptrdiff_t)columns[i + 1], low[k], rate[k],
                       counts + N_STEPS * k);
        }
}

FOR_ANY_PROCESSOR
static void run_cubics(const float *coefficients, const double *edges, ptrdiff_t n_pieces,
                       const float *offset, int subtract, float *image, ptrdiff_t ny,
                       ptrdiff_t nx) {
    for (ptrdiff_t y = 0; y < ny; y++)
        row_cubics(coefficients + 4 * n_pieces * y, edges, n_pieces, offset, subtract,
                   image + nx * y);
}

FOR_ANY_PROCESSOR
static void run_mark(const float *image, const float *rms, const unsigned char *mask, ptrdiff_t ny,
                     ptrdiff_t nx, const float *line, ptrdiff_t half, float factor, ptrdiff_t size,
                     ptrdiff_t first, ptrdiff_t last, float *work, const float **rows,
                     unsigned char *cells) {
    mark_cells_between(image, rms, mask, ny, nx, line, half, factor, size, first, last, work, rows,
                       cells);
}

/* ---- arguments ------------------------------------------------------------------------------ */

#define MOST_BUFFERS 24

typedef struct {
    Py_buffer views[MOST_BUFFERS];
    int n;
} Buffers;

static void release(Buffers *held) {
    while (held->n) PyBuffer_Release(&held->views[--held->n]);
}

/* Return the memory of a contiguous array of one type, or NULL with an exception set. */
static void *memory(Buffers *held, PyObject *object, char type, size_t width, int writable,
                    ptrdiff_t *size) {
    Py_buffer *view = &held->views[held->n];
    int flags = PyBUF_FORMAT | PyBUF_C_CONTIGUOUS | (writable ? PyBUF_WRITABLE : 0);
    if (PyObject_GetBuffer(object, view, flags) < 0) return NULL;
    held->n++;
    const char *format = view->format ? view->format : "B";
    if (*format == '@' || *format == '=') format++;
    if ((size_t)view->itemsize != width || format[0] != type || format[1] != '\0') {
        PyErr_Format(PyExc_TypeError, "kernels take contiguous arrays of the type '%c' here", type);
        return NULL;
    }
    *size = view->len / (ptrdiff_t)width;
    /* An array without elements may have no memory. */
    return view->buf ? view->buf : view;
}

/* Whole numbers; returns 0 with an exception set if they are none. */
static int whole_numbers(PyObject *const *args, int n, ptrdiff_t *values) {
    for (int k = 0; k < n; k++) {
        values[k] = PyNumber_AsSsize_t(args[k], PyExc_OverflowError);
        if (PyErr_Occurred()) return 0;
    }
    return 1;
}

/* The numbers of a contiguous float64 array. */
static double *numbers(Buffers *held, PyObject *object, int writable, ptrdiff_t *size) {
    return memory(held, object, 'd', sizeof(double), writable, size);
}

/* The same for an array of known size. */
static double *exactly(Buffers *held, PyObject *object, int writable, ptrdiff_t size) {
    ptrdiff_t found;
    double *values = numbers(held, object, writable, &found);
    if (values && found != size) {
        PyErr_Format(PyExc_ValueError, "kernels need %zd numbers here, not %zd", (Py_ssize_t)size,
                     (Py_ssize_t)found);
        return NULL;
    }
    return values;
}

static int read_plane(Buffers *held, PyObject *object, Plane *plane) {
    if (!PyTuple_Check(object) || PyTuple_Size(object) != 4) {
        PyErr_SetString(PyExc_TypeError, "a map of the plane is a tuple of four arrays");
        return -1;
    }
    const double *parts[4];
    ptrdiff_t sizes[4];
    for (int k = 0; k < 4; k++) {
        parts[k] = numbers(held, PyTuple_GetItem(object, k), 0, &sizes[k]);
        if (!parts[k]) return -1;
    }
    const double *head = parts[0];
    ptrdiff_t n = 0, n_radial = sizes[2] / 4;
    while (6 * n * n < sizes[1]) n++;
    if (sizes[0] != 14 || 6 * n * n != sizes[1] || 4 * n_radial != sizes[2] ||
        (n_radial && !n) || !(n || sizes[3])) {
        PyErr_SetString(PyExc_ValueError, "the arrays make no map of the plane");
        return -1;
    }
    plane->x_low = head[0], plane->x_high = head[1], plane->x_step = head[2];
    plane->y_low = head[3], plane->y_high = head[4], plane->y_step = head[5];
    plane->nx = (ptrdiff_t)head[6], plane->ny = (ptrdiff_t)head[7];
    plane->x0 = head[8], plane->y0 = head[9];
    plane->m00 = head[10], plane->m01 = head[11], plane->m10 = head[12], plane->m11 = head[13];
    plane->polynomial = n ? parts[1] : NULL, plane->n = n;
    plane->radial = n_radial ? parts[2] : NULL, plane->n_radial = n_radial;
    plane->table = sizes[3] ? parts[3] : NULL;
    if (sizes[3] && (plane->nx < 1 || plane->ny < 1 ||
                     32 * (plane->nx + 2) * (plane->ny + 2) != sizes[3])) {
        PyErr_SetString(PyExc_ValueError, "the table has another number of cells");
        return -1;
    }
    return 0;
}

static int read_tangent(Buffers *held, PyObject *object, Tangent *tangent) {
    const double *v = exactly(held, object, 0, 9);
    if (!v) return -1;
    tangent->ra0 = v[0], tangent->sin0 = v[1], tangent->cos0 = v[2];
    tangent->m00 = v[3], tangent->m01 = v[4], tangent->m10 = v[5], tangent->m11 = v[6];
    tangent->x0 = v[7], tangent->y0 = v[8];
    return 0;
}

static int read_box(Buffers *held, PyObject *object, Box *box) {
    const double *v = exactly(held, object, 0, 5);
    if (!v) return -1;
    box->x_low = v[0], box->x_high = v[1], box->y_low = v[2], box->y_high = v[3], box->fill = v[4];
    return 0;
}

static int count(Py_ssize_t given, Py_ssize_t wanted) {
    if (given == wanted) return 0;
    PyErr_Format(PyExc_TypeError, "%zd arguments are needed, not %zd", wanted, given);
    return -1;
}

/* Size of the inputs x, y and the outputs, or -1 with an exception set if they differ. */
static ptrdiff_t read_points(Buffers *held, PyObject *const *args, int n_outputs, double **arrays) {
    ptrdiff_t size;
    arrays[0] = numbers(held, args[0], 0, &size);
    if (!arrays[0]) return -1;
    for (int k = 1; k < 2 + n_outputs; k++) {
        arrays[k] = exactly(held, args[k], k > 1, size);
        if (!arrays[k]) return -1;
    }
    return size;
}

static PyObject *finish(Buffers *held, int good) {
    release(held);
    if (!good) return NULL;
    Py_INCREF(Py_None);
    return Py_None;
}

/* ---- functions ------------------------------------------------------------------------------ */

static PyObject *evaluate(PyObject *self, PyObject *const *args, Py_ssize_t n_args) {
    Buffers held = {.n = 0};
    Plane plane;
    double *p[4];
    ptrdiff_t size = -1;
    (void)self;
    if (count(n_args, 5) == 0 && read_plane(&held, args[0], &plane) == 0 &&
        (size = read_points(&held, args + 1, 2, p)) >= 0) {
        Py_BEGIN_ALLOW_THREADS
        run_evaluate(&plane, p[0], p[1], size, p[2], p[3]);
        Py_END_ALLOW_THREADS
    }
    return finish(&held, size >= 0);
}

static PyObject *jacobian(PyObject *self, PyObject *const *args, Py_ssize_t n_args) {
    Buffers held = {.n = 0};
    Plane plane;
    double *p[8];
    ptrdiff_t size = -1;
    (void)self;
    if (count(n_args, 9) == 0 && read_plane(&held, args[0], &plane) == 0 &&
        (size = read_points(&held, args + 1, 6, p)) >= 0) {
        Py_BEGIN_ALLOW_THREADS
        run_jacobian(&plane, p[0], p[1], size, p + 2);
        Py_END_ALLOW_THREADS
    }
    return finish(&held, size >= 0);
}

static PyObject *to_sky(PyObject *self, PyObject *const *args, Py_ssize_t n_args) {
    Buffers held = {.n = 0};
    Plane plane, cells;
    Tangent tangent;
    Box box;
    double *p[4];
    ptrdiff_t size = -1;
    (void)self;
    if (count(n_args, 8) == 0 && read_plane(&held, args[0], &plane) == 0 &&
        (args[1] == Py_None || read_plane(&held, args[1], &cells) == 0) &&
        read_tangent(&held, args[2], &tangent) == 0 &&
        (args[3] == Py_None || read_box(&held, args[3], &box) == 0) &&
        (size = read_points(&held, args + 4, 2, p)) >= 0) {
        const Plane *used_cells = args[1] == Py_None ? NULL : &cells;
        const Box *used_box = args[3] == Py_None ? NULL : &box;
        Py_BEGIN_ALLOW_THREADS
        run_to_sky(&plane, used_cells, &tangent, used_box, p[0], p[1], size, p[2], p[3]);
        Py_END_ALLOW_THREADS
    }
    return finish(&held, size >= 0);
}

static PyObject *rows_to_sky(PyObject *self, PyObject *const *args, Py_ssize_t n_args) {
    Buffers held = {.n = 0};
    Plane plane, cells;
    Tangent tangent;
    ptrdiff_t n_x, n_y;
    const double *x, *y;
    double *ra, *dec;
    int good = 0;
    (void)self;
    if (count(n_args, 7) == 0 && read_plane(&held, args[0], &plane) == 0 &&
        (args[1] == Py_None || read_plane(&held, args[1], &cells) == 0) &&
        read_tangent(&held, args[2], &tangent) == 0 && (x = numbers(&held, args[3], 0, &n_x)) &&
        (y = numbers(&held, args[4], 0, &n_y)) && (ra = exactly(&held, args[5], 1, n_x * n_y)) &&
        (dec = exactly(&held, args[6], 1, n_x * n_y))) {
        const Plane *used_cells = args[1] == Py_None ? NULL : &cells;
        Py_BEGIN_ALLOW_THREADS
        run_rows(&plane, used_cells, &tangent, x, n_x, y, n_y, ra, dec);
        Py_END_ALLOW_THREADS
        good = 1;
    }
    return finish(&held, good);
}

static PyObject *from_sky(PyObject *self, PyObject *const *args, Py_ssize_t n_args) {
    Buffers held = {.n = 0};
    Tangent tangent;
    double *p[4];
    ptrdiff_t size = -1;
    (void)self;
    if (count(n_args, 5) == 0 && read_tangent(&held, args[0], &tangent) == 0 &&
        (size = read_points(&held, args + 1, 2, p)) >= 0) {
        Py_BEGIN_ALLOW_THREADS
        run_project(&tangent, p[0], p[1], size, p[2], p[3]);
        Py_END_ALLOW_THREADS
    }
    return finish(&held, size >= 0);
}

static PyObject *invert(PyObject *self, PyObject *const *args, Py_ssize_t n_args) {
    Buffers held = {.n = 0};
    Plane plane, start;
    Tangent tangent;
    Box box;
    const double *limits;
    double *p[4];
    ptrdiff_t size = -1;
    (void)self;
    if (count(n_args, 9) == 0 && read_plane(&held, args[0], &plane) == 0 &&
        (args[1] == Py_None || read_plane(&held, args[1], &start) == 0) &&
        (limits = exactly(&held, args[2], 0, 4)) &&
        (args[3] == Py_None || read_tangent(&held, args[3], &tangent) == 0) &&
        (args[4] == Py_None || read_box(&held, args[4], &box) == 0) &&
        (size = read_points(&held, args + 5, 2, p)) >= 0) {
        const Inverse inverse = {.plane = &plane,
                                 .start = args[1] == Py_None ? NULL : &start,
                                 .sky = args[3] == Py_None ? NULL : &tangent,
                                 .box = args[4] == Py_None ? NULL : &box,
                                 .tolerance = limits[0],
                                 .curvature = limits[1],
                                 .sign = limits[2],
                                 .rim = limits[3]};
        Py_BEGIN_ALLOW_THREADS
        run_invert(&inverse, p[0], p[1], size, p[2], p[3]);
        Py_END_ALLOW_THREADS
    }
    return finish(&held, size >= 0);
}

/* The point-spread function: grids, oversampling, phases, shares, half; number of stars or -1.
 * Its work space is the caller's to free. */
static ptrdiff_t read_stars(Buffers *held, PyObject *const *args, Spline *spline,
                            const double **phases, const double **shares, ptrdiff_t *half) {
    ptrdiff_t n_knots, n_phases, n_shares;
    if (!(spline->grids = numbers(held, args[0], 0, &n_knots))) return -1;
    const Py_buffer *view = &held->views[held->n - 1];
    spline->oversampling = PyNumber_AsSsize_t(args[1], PyExc_OverflowError);
    if (!(*phases = numbers(held, args[2], 0, &n_phases))) return -1;
    if (!(*shares = numbers(held, args[3], 0, &n_shares))) return -1;
    *half = PyNumber_AsSsize_t(args[4], PyExc_OverflowError);
    if (PyErr_Occurred()) return -1;
    const ptrdiff_t n_stars = n_phases / N_PHASE;
    const int good = view->ndim == 3 && view->shape[1] == view->shape[2];
    spline->n_grids = good ? view->shape[0] : 0, spline->size = good ? view->shape[1] : 0;
    if (!good || n_phases != N_PHASE * n_stars || n_shares != n_stars * spline->n_grids ||
        spline->oversampling < 1 || spline->oversampling > 1000 || *half < 0 || *half > 100000) {
        PyErr_SetString(PyExc_ValueError, "the arrays make no stars");
        return -1;
    }
    spline->line = malloc(3 * sizeof(double) * (size_t)columns_of(spline->oversampling, *half));
    if (!spline->line) {
        PyErr_NoMemory();
        return -1;
    }
    return n_stars;
}

static PyObject *star_profiles(PyObject *self, PyObject *const *args, Py_ssize_t n_args) {
    Buffers held = {.n = 0};
    Spline spline = {.line = NULL};
    const double *phases, *shares;
    double *profiles;
    ptrdiff_t half, n_stars, n_out;
    int good = 0;
    (void)self;
    if (count(n_args, 6) == 0 &&
        (n_stars = read_stars(&held, args, &spline, &phases, &shares, &half)) >= 0 &&
        (profiles = numbers(&held, args[5], 1, &n_out))) {
        const ptrdiff_t n = n_stars * (2 * half + 1) * (2 * half + 1);
        if (n_out != n && n_out != 3 * n) {
            PyErr_SetString(PyExc_ValueError, "the profiles have another size");
        } else {
            Py_BEGIN_ALLOW_THREADS
            run_profiles(&spline, phases, shares, half, n_stars, n_out != n, profiles);
            Py_END_ALLOW_THREADS
            good = 1;
        }
    }
    free(spline.line);
    return finish(&held, good);
}

static PyObject *paint_stars(PyObject *self, PyObject *const *args, Py_ssize_t n_args) {
    Buffers held = {.n = 0};
    Spline spline = {.line = NULL};
    const double *phases, *shares, *centers, *flux;
    float *image;
    ptrdiff_t half, n_stars, n_image;
    int good = 0;
    (void)self;
    if (count(n_args, 8) == 0 &&
        (n_stars = read_stars(&held, args, &spline, &phases, &shares, &half)) >= 0 &&
        (centers = exactly(&held, args[5], 0, 2 * n_stars)) &&
        (flux = exactly(&held, args[6], 0, n_stars)) &&
        (image = memory(&held, args[7], 'f', sizeof(float), 1, &n_image))) {
        const Py_buffer *view = &held.views[held.n - 1];
        if (view->ndim != 2) {
            PyErr_SetString(PyExc_ValueError, "the image must have two dimensions");
        } else {
            const ptrdiff_t ny = view->shape[0], nx = view->shape[1];
            Py_BEGIN_ALLOW_THREADS
            run_paint(&spline, phases, shares, half, centers, flux, n_stars, image, ny, nx);
            Py_END_ALLOW_THREADS
            good = 1;
        }
    }
    free(spline.line);
    return finish(&held, good);
}

static PyObject *take_stars(PyObject *self, PyObject *const *args, Py_ssize_t n_args) {
    Buffers held = {.n = 0};
    const double *centers;
    float *light, *image;
    ptrdiff_t n_centers, n_light, n_image;
    int good = 0;
    (void)self;
    if (count(n_args, 6) || !(centers = numbers(&held, args[0], 0, &n_centers)) ||
        !(light = memory(&held, args[4], 'f', sizeof(float), 1, &n_light)))
        return finish(&held, 0);
    const Py_buffer *view = &held.views[held.n - 1];
    const int flat = view->ndim == 2;
    const ptrdiff_t ny = flat ? view->shape[0] : 0, nx = flat ? view->shape[1] : 0;
    ptrdiff_t whole[3]; /* half, first, last */
    if (whole_numbers(args + 1, 3, whole) && (image = memory(&held, args[5], 'f', sizeof(float), 1, &n_image))) {
        if (!flat || n_image != n_light || n_centers % 2 || whole[0] < 0 || whole[0] > 1000000) {
            PyErr_SetString(PyExc_ValueError, "the image and the light must have the same shape");
        } else {
            Py_BEGIN_ALLOW_THREADS
            run_take(centers, n_centers / 2, whole[0], whole[1], whole[2], light, image, ny, nx);
            Py_END_ALLOW_THREADS
            good = 1;
        }
    }
    return finish(&held, good);
}

static PyObject *star_steps(PyObject *self, PyObject *const *args, Py_ssize_t n_args) {
    Buffers held = {.n = 0};
    const double *profiles, *flux, *pixels, *variance, *photons = NULL, *noise;
    const unsigned char *use;
    double *step, *covariance, *chi2;
    ptrdiff_t n_all, n_stars, n_use;
    int good = 0;
    (void)self;
    if (count(n_args, 10) == 0 && (pixels = numbers(&held, args[2], 0, &n_all)) &&
        (flux = numbers(&held, args[1], 0, &n_stars)) &&
        (profiles = exactly(&held, args[0], 0, 3 * n_all)) &&
        (use = memory(&held, args[3], '?', 1, 0, &n_use)) &&
        (variance = exactly(&held, args[4], 0, n_all)) &&
        (args[5] == Py_None || (photons = exactly(&held, args[5], 0, n_all))) &&
        (noise = exactly(&held, args[6], 0, 2)) &&
        (step = exactly(&held, args[7], 1, 3 * n_stars)) &&
        (covariance = exactly(&held, args[8], 1, 9 * n_stars)) &&
        (chi2 = exactly(&held, args[9], 1, n_stars))) {
        const ptrdiff_t n = n_stars ? n_all / n_stars : 0;
        if (n * n_stars != n_all || n_use != n_all) {
            PyErr_SetString(PyExc_ValueError, "the pixels have another size");
        } else {
            const NoiseNumbers numbers_of = {noise[0], noise[1]};
            Py_BEGIN_ALLOW_THREADS
            run_steps(profiles, flux, pixels, use, variance, photons, numbers_of, n_stars, n, step,
                      covariance, chi2);
            Py_END_ALLOW_THREADS
            good = 1;
        }
    }
    return finish(&held, good);
}

/* Edges of parts of an axis: whole numbers that ascend from 0 or more to `size` or less.  Returns
 * the number of parts, or -1 with an exception set. */
static ptrdiff_t read_edges(Buffers *held, PyObject *object, ptrdiff_t size, const double **edges) {
    ptrdiff_t n;
    if (!(*edges = numbers(held, object, 0, &n))) return -1;
    int good = n > 1 && (*edges)[0] >= 0 && (*edges)[n - 1] <= (double)size;
    for (ptrdiff_t k = 1; good && k < n; k++) good = (*edges)[k] >= (*edges)[k - 1];
    if (good) return n - 1;
    PyErr_SetString(PyExc_ValueError, "the edges do not ascend within the image");
    return -1;
}

static PyObject *count_levels(PyObject *self, PyObject *const *args, Py_ssize_t n_args) {
    Buffers held = {.n = 0};
    const float *image, *low, *rate;
    const unsigned char *mask = NULL;
    const double *rows, *columns;
    int32_t *counts;
    ptrdiff_t n_image, n_mask, n_low, n_rate, n_counts, n_rows, n_columns;
    int good = 0;
    (void)self;
    if (count(n_args, 7) == 0 && (image = memory(&held, args[0], 'f', sizeof(float), 0, &n_image))) {
        const Py_buffer *view = &held.views[held.n - 1];
        const int flat = view->ndim == 2;
        const ptrdiff_t ny = flat ? view->shape[0] : 0, nx = flat ? view->shape[1] : 0;
        n_mask = n_image;
        if ((args[1] == Py_None || (mask = memory(&held, args[1], '?', 1, 0, &n_mask))) &&
            (n_rows = read_edges(&held, args[2], ny, &rows)) >= 0 &&
            (n_columns = read_edges(&held, args[3], nx, &columns)) >= 0 &&
            (low = memory(&held, args[4], 'f', sizeof(float), 0, &n_low)) &&
            (rate = memory(&held, args[5], 'f', sizeof(float), 0, &n_rate)) &&
            (counts = memory(&held, args[6], 'i', sizeof(int32_t), 1, &n_counts))) {
            const ptrdiff_t n = n_rows * n_columns;
            if (n_mask != n_image || n_low != n || n_rate != n || n_counts != N_STEPS * n) {
                PyErr_SetString(PyExc_ValueError, "the arrays make no cells");
            } else {
                Py_BEGIN_ALLOW_THREADS
                run_count(image, mask, nx, rows, n_rows, columns, n_columns, low, rate, counts);
                Py_END_ALLOW_THREADS
                good = 1;
            }
        }
    }
    return finish(&held, good);
}

static PyObject *put_cubics(PyObject *self, PyObject *const *args, Py_ssize_t n_args) {
    Buffers held = {.n = 0};
    const float *coefficients, *offset;
    const double *edges;
    float *image;
    ptrdiff_t n_coefficients, n_pieces, nx, n_image;
    int subtract, good = 0;
    (void)self;
    if (count(n_args, 5) == 0 &&
        (coefficients = memory(&held, args[0], 'f', sizeof(float), 0, &n_coefficients)) &&
        (offset = memory(&held, args[2], 'f', sizeof(float), 0, &nx)) &&
        (n_pieces = read_edges(&held, args[1], nx, &edges)) >= 0 &&
        (subtract = PyObject_IsTrue(args[3])) >= 0 &&
        (image = memory(&held, args[4], 'f', sizeof(float), 1, &n_image))) {
        const ptrdiff_t ny = nx ? n_image / nx : 0;
        if (ny * nx != n_image || 4 * n_pieces * ny != n_coefficients) {
            PyErr_SetString(PyExc_ValueError, "the arrays make no cubics in the rows of an image");
        } else {
            Py_BEGIN_ALLOW_THREADS
            run_cubics(coefficients, edges, n_pieces, offset, subtract, image, ny, nx);
            Py_END_ALLOW_THREADS
            good = 1;
        }
    }
    return finish(&held, good);
}

static PyObject *mark_cells(PyObject *self, PyObject *const *args, Py_ssize_t n_args) {
    Buffers held = {.n = 0};
    const float *image, *rms, *line;
    const unsigned char *mask = NULL;
    unsigned char *cells;
    ptrdiff_t n_image, n_rms, n_mask, n_line, n_cells;
    int good = 0;
    (void)self;
    if (count(n_args, 9) || !(image = memory(&held, args[0], 'f', sizeof(float), 0, &n_image)))
        return finish(&held, 0);
    const Py_buffer *view = &held.views[held.n - 1];
    const int flat = view->ndim == 2;
    const ptrdiff_t ny = flat ? view->shape[0] : 0, nx = flat ? view->shape[1] : 0;
    n_mask = n_image;
    if ((rms = memory(&held, args[1], 'f', sizeof(float), 0, &n_rms)) &&
        (args[2] == Py_None || (mask = memory(&held, args[2], '?', 1, 0, &n_mask))) &&
        (line = memory(&held, args[3], 'f', sizeof(float), 0, &n_line)) &&
        (cells = memory(&held, args[8], '?', 1, 1, &n_cells))) {
        ptrdiff_t whole[3]; /* size, first, last */
        const double factor = PyFloat_AsDouble(args[4]);
        if (PyErr_Occurred() || !whole_numbers(args + 5, 3, whole)) return finish(&held, 0);
        const ptrdiff_t size = whole[0], first = whole[1], last = whole[2];
        const ptrdiff_t m = size > 0 ? (ny + size - 1) / size : 0;
        if (!flat || n_rms != n_image || n_mask != n_image || n_line % 2 == 0 || size < 1 ||
            n_cells != m * ((nx + size - 1) / size) || first < 0 || last > m) {
            PyErr_SetString(PyExc_ValueError, "the arrays make no cells");
            return finish(&held, 0);
        }
        float *work = malloc((size_t)((n_line + 1) * (nx + n_line)) * sizeof(float));
        const float **rows = malloc((size_t)n_line * sizeof(float *));
        if (work && rows) {
            Py_BEGIN_ALLOW_THREADS
            run_mark(image, rms, mask, ny, nx, line, n_line / 2, (float)factor, size, first, last,
                     work, rows, cells);
            Py_END_ALLOW_THREADS
            good = 1;
        } else {
            PyErr_NoMemory();
        }
        free(work);
        free(rows);
    }
    return finish(&held, good);
}

#define METHOD(name) {#name, (PyCFunction)(void (*)(void))name, METH_FASTCALL, NULL}

static PyMethodDef methods[] = {
    METHOD(evaluate), METHOD(jacobian), METHOD(to_sky), METHOD(rows_to_sky),
    METHOD(from_sky), METHOD(invert),   METHOD(star_profiles), METHOD(paint_stars),
    METHOD(star_steps), METHOD(count_levels), METHOD(put_cubics),
    METHOD(mark_cells), METHOD(take_stars), {NULL, NULL, 0, NULL},
};

/* Cells in memory, all of a cell side by side: four cache lines. */
static int add_constants(PyObject *self) {
    return PyModule_AddStringConstant(self, "CELL_ORDER", "jiqkp");
}

static PyModuleDef_Slot slots[] = {{Py_mod_exec, (void *)add_constants}, {0, NULL}};

static struct PyModuleDef module = {
    .m_base = PyModuleDef_HEAD_INIT,
    .m_name = "_compiled",
    .m_doc = "The kernels, compiled.",
    .m_size = 0,
    .m_methods = methods,
    .m_slots = slots,
};

PyMODINIT_FUNC PyInit__compiled(void) { return PyModuleDef_Init(&module); }
