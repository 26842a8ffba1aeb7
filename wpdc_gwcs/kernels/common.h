/* What all kernels have in common.
 *
 * Every kernel of the WCS is the same sequence of additions, multiplications, divisions, square roots and
 * comparisons as its counterpart in in_numpy.py, and is compiled without contraction to fused
 * operations: the results have the same bits.  Whoever changes one changes the other;
 * tests/test_kernels.py compares them.
 */
#ifndef WPDC_COMMON_H
#define WPDC_COMMON_H

#include <math.h>
#include <stddef.h>

/* Points that are worked on at a time: their work space stays in the first-level cache. */
#define BLOCK 128
/* Points that go through the inner loops together: as many as fill the vector registers. */
#define LANES 8

/* Where the linker can choose at run time, code for wider registers goes along with that for any
 * processor of the kind.  None has fused operations.  A row of coefficients of a cell fills one
 * register of the widest kind: to the sky takes two thirds of the time of the next one. */
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

/* Adding and subtracting it rounds numbers of up to 2^51 to integers. */
#define ROUND_BIAS 6755399441055744.0

INLINE double round_even(double v) {
    double rounded = v + ROUND_BIAS;
    return rounded - ROUND_BIAS;
}

#endif
