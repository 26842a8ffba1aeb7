/* Sine, cosine and arc tangent in degrees, without branches, so that loops over them are vectorized.
 *
 * The polynomials are those of fdlibm (Sun Microsystems, 1993: "Permission to use, copy, modify,
 * and distribute this software is freely granted, provided that this notice is preserved").
 * Relative errors are below 4e-16.
 */
#ifndef WPDC_ANGLES_H
#define WPDC_ANGLES_H

#include "common.h"

#define RADIAN 0.017453292519943295 /* degrees to radians */
#define DEGREE 57.29577951308232    /* radians to degrees */

/* Larger angles, in degrees, cannot be coordinates. */
#define GREATEST_ANGLE 1e9

INLINE void sin_cos(double angle, double *sine, double *cosine) {
    angle = fabs(angle) <= GREATEST_ANGLE ? angle : NAN;
    /* Quarter turns are subtracted in degrees, where they are exact. */
    double quarters = round_even(angle * (1.0 / 90.0));
    double x = (angle - quarters * 90.0) * RADIAN;
    double z = x * x;
    double s = x + (z * x) * (-1.66666666666666324348e-01 +
        z * (8.33333333332248946124e-03 + z * (-1.98412698298579493134e-04 +
        z * (2.75573137070700676789e-06 + z * (-2.50507602534068634195e-08 +
        z * 1.58969099521155010221e-10)))));
    double half = 0.5 * z;
    double w = 1.0 - half;
    double c = w + (((1.0 - w) - half) + z * (z * (4.16666666666666019037e-02 +
        z * (-1.38888888888741095749e-03 + z * (2.48015872894767294178e-05 +
        z * (-2.75573143513906633035e-07 + z * (2.08757232129817482790e-09 +
        z * -1.13596475577881948265e-11)))))));
    /* -2 to 2 */
    double turn = quarters - 4.0 * round_even(quarters * 0.25);
    double size = fabs(turn);
    double first = size == 1.0 ? c : s;
    double second = size == 1.0 ? s : c;
    double first_sign = turn < 0.0 ? -1.0 : 1.0;
    double second_sign = turn > 0.0 ? -1.0 : 1.0;
    *sine = first * (size == 2.0 ? -1.0 : first_sign);
    *cosine = second * (size == 2.0 ? -1.0 : second_sign);
}

/* Angle of the direction (x, y) in degrees, -180 to 180; 0 where both are 0. */
INLINE double arc_tangent(double y, double x) {
    double up = fabs(y);
    double along = fabs(x);
    /* atan(y / x) is one of a few angles plus the arc tangent of a small number. */
    double numerator = up, denominator = along, base = 0.0, rest = 0.0;
    int far = up > 0.4375 * along;
    numerator = far ? 2.0 * up - along : numerator;
    denominator = far ? 2.0 * along + up : denominator;
    base = far ? 4.63647609000806093515e-01 : base;
    rest = far ? 2.26987774529616870924e-17 : rest;
    far = up > 0.6875 * along;
    numerator = far ? up - along : numerator;
    denominator = far ? along + up : denominator;
    base = far ? 7.85398163397448278999e-01 : base;
    rest = far ? 3.06161699786838301793e-17 : rest;
    far = up > 1.1875 * along;
    numerator = far ? up - 1.5 * along : numerator;
    denominator = far ? along + 1.5 * up : denominator;
    base = far ? 9.82793723247329054082e-01 : base;
    rest = far ? 1.39033110312309984516e-17 : rest;
    far = up > 2.4375 * along;
    numerator = far ? -along : numerator;
    denominator = far ? up : denominator;
    base = far ? 1.57079632679489655800e+00 : base;
    rest = far ? 6.12323399573676603587e-17 : rest;
    double v = numerator / denominator;
    double z = v * v;
    double sum = z * (3.33333333333329318027e-01 + z * (-1.99999999998764832476e-01 +
        z * (1.42857142725034663711e-01 + z * (-1.11111104054623557880e-01 +
        z * (9.09088713343650656196e-02 + z * (-7.69187620504482999495e-02 +
        z * (6.66107313738753120669e-02 + z * (-5.83357013379057348645e-02 +
        z * (4.97687799461593236017e-02 + z * (-3.65315727442169155270e-02 +
        z * 1.62858201153657823623e-02))))))))));
    double angle = base - ((v * sum - rest) - v);
    angle *= DEGREE;
    angle = up == 0.0 ? 0.0 : angle;
    angle = x < 0.0 ? 180.0 - angle : angle;
    return y < 0.0 ? -angle : angle;
}

/* Right ascension from -180 to 540 degrees into the range from 0 to 360. */
INLINE double wrap(double ra) {
    ra += ra < 0.0 ? 360.0 : (ra >= 360.0 ? -360.0 : 0.0);
    /* A tiny negative angle was rounded up to 360. */
    return ra >= 360.0 ? 0.0 : ra;
}

#endif
