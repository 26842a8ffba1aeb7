/* Definitions that all kernels share.
 *
 * Every kernel of the WCS makes the same additions, multiplications, divisions, square roots and
 * comparisons as its counterpart in in_numpy.py, in the same order, and is compiled without fused
 * operations.  The results are therefore identical to the last bit.  A change to one must be made to
 * the other as well; tests/test_kernels.py compares them.
 */
#ifndef WPDC_COMMON_H
#define WPDC_COMMON_H

#include <math.h>
#include <stddef.h>

/* Number of points in a block, whose work space fits into the first-level cache. */
#define BLOCK 128
/* Number of points that the inner loops process together, to fill the vector registers. */
#define LANES 8

/* Where the program can choose at run time, functions are compiled for wider registers as well, always
 * without fused operations.  A row of coefficients of a cell fills one 512-bit register, with which
 * going to the sky takes two thirds of the time that it takes with 256 bits. */
#if defined(__x86_64__) && defined(__linux__) && defined(__GLIBC__) && !defined(__AVX2__) && \
    defined(__GNUC__) && !defined(__clang__) && __GNUC__ >= 8
#define FOR_ANY_PROCESSOR __attribute__((target_clones("avx512f", "avx2", "default")))
#else
#define FOR_ANY_PROCESSOR
#endif

#if defined(__GNUC__)
#define INLINE static inline __attribute__((always_inline))
#else
#define INLINE static inline
#endif

#if defined(_MSC_VER)
#pragma fp_contract(off)
#endif

/* Adding and then subtracting this number rounds values of up to 2^51 to integers. */
#define ROUND_BIAS 6755399441055744.0

INLINE double round_even(double v) {
    double rounded = v + ROUND_BIAS;
    return rounded - ROUND_BIAS;
}

#endif
