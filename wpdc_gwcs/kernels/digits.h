/* Numbers as text: the shortest that reads back to the same number, as `repr` writes it.
 *
 * A number f 2^e is scaled by a power of ten to 17 digits before the point, in whole numbers of 128
 * bits, exactly.  Of 15 and 16 digits the nearest number is the text if it lies within half a unit
 * in the last place of f, for then it reads back; 17 digits always do.
 */
#ifndef WPDC_DIGITS_H
#define WPDC_DIGITS_H

#include <math.h>
#include <stdint.h>
#include <string.h>

/* Text of a number: a sign, 17 digits, a point, zeros before them or an exponent. */
#define MOST_TEXT 32

#if defined(__SIZEOF_INT128__)
typedef unsigned __int128 Wide;

/* Within them 2 f 10^k fits into 128 bits (k is 22 at most), and there are bits behind the point. */
#define LEAST_SCALED 2e-6
#define END_SCALED 4503599627370496.0 /* 2^52 */

static const uint64_t TENS[] = {1ull,
                                10ull,
                                100ull,
                                1000ull,
                                10000ull,
                                100000ull,
                                1000000ull,
                                10000000ull,
                                100000000ull,
                                1000000000ull,
                                10000000000ull,
                                100000000000ull};

/* Write 0 < whole < 10^18, without the zeros at its end; return how many digits there are left. */
static int write_digits(uint64_t whole, char *text, int *n_all) {
    char reversed[20];
    int n = 0, zeros = 0;
    for (; whole; whole /= 10) reversed[n++] = (char)('0' + whole % 10);
    while (reversed[zeros] == '0') zeros++;
    for (int k = n - 1, j = 0; k >= zeros; k--, j++) text[j] = reversed[k];
    *n_all = n;
    return n - zeros;
}

/* Write digits d1 d2 ... as 0.d1d2... times 10^point in the manner of `repr`; return the length. */
static int write_number(int negative, const char *digits, int n, int point, char *text) {
    char *p = text;
    if (negative) *p++ = '-';
    if (point <= -4) {
        *p++ = digits[0];
        if (n > 1) {
            *p++ = '.';
            memcpy(p, digits + 1, (size_t)(n - 1));
            p += n - 1;
        }
        *p++ = 'e', *p++ = '-', *p++ = '0', *p++ = (char)('0' + (1 - point));
    } else if (point <= 0) {
        *p++ = '0', *p++ = '.';
        for (int k = 0; k < -point; k++) *p++ = '0';
        memcpy(p, digits, (size_t)n);
        p += n;
    } else {
        for (int k = 0; k < point; k++) *p++ = k < n ? digits[k] : '0';
        *p++ = '.';
        if (n > point) {
            memcpy(p, digits + point, (size_t)(n - point));
            p += n - point;
        } else {
            *p++ = '0';
        }
    }
    return (int)(p - text);
}

/* Write a number; return the length of its text, 0 for one that has to be written otherwise. */
static int shortest(double value, char *text) {
    const double size = fabs(value);
    uint64_t bits;
    /* Written so that NaN is left to others. */
    if (!(size >= LEAST_SCALED && size < END_SCALED)) return 0;
    memcpy(&bits, &size, sizeof bits);
    const uint64_t fraction = bits & 0xFFFFFFFFFFFFFull;
    /* Below a power of two numbers lie closer. */
    if (!fraction) return 0;
    const uint64_t f = fraction | 0x10000000000000ull;
    const int behind = 1075 - (int)(bits >> 52); /* bits behind the point, 1 or more */
    int scale = 16 - (int)floor(log10(size));
    Wide factor, scaled, unit = (Wide)1 << (behind + 1);
    uint64_t whole;
    for (;;) {
        factor = scale > 11 ? (Wide)TENS[11] * TENS[scale - 11] : (Wide)TENS[scale];
        scaled = 2 * (Wide)f * factor;
        whole = (uint64_t)(scaled >> (behind + 1));
        /* Close to a power of ten its logarithm may be rounded to either side. */
        if (whole >= 100000000000000000ull) scale--;
        else if (whole < 10000000000000000ull) scale++;
        else break;
    }
    const Wide rest = scaled & (unit - 1);
    char digits[20];
    for (int dropped = 2; dropped >= 0; dropped--) {
        const uint64_t ten = TENS[dropped];
        uint64_t kept = whole / ten;
        const Wide step = ten * unit, left = (Wide)(whole % ten) * unit + rest;
        const int up = 2 * left > step || (2 * left == step && (kept & 1));
        const Wide distance = up ? step - left : left;
        /* Half a unit in the last place of f is 10^scale here. */
        if (distance == factor) return 0;
        if (distance < factor || !dropped) {
            int n_all, n = write_digits(kept + (uint64_t)up, digits, &n_all);
            return write_number(value < 0.0, digits, n, n_all + dropped - scale, text);
        }
    }
    return 0;
}

#else
static int shortest(double value, char *text) {
    (void)value, (void)text;
    return 0;
}
#endif

#endif
