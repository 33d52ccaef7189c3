/* The slider-crank of cases/slider_crank.py as Siconos takes it: functions of a compiled plugin.

   Angles q of crank, rod and slider; its numbers come as macros from siconos.py. Each corner tells its
   gap, and the rates of the gap and of its sliding along the guide. */

#include <math.h>

#define COUPLED ((0.5 * ROD_MASS + SLIDER_MASS) * CRANK * ROD)
#define WEIGHT(own, carried) ((0.5 * (own) + (carried)) * GRAVITY)

void mass(unsigned n, const double *q, double *m, unsigned k, double *z) {
    double both = COUPLED * cos(q[1] - q[0]);
    m[0] = CRANK_INERTIA + (0.25 * CRANK_MASS + ROD_MASS + SLIDER_MASS) * CRANK * CRANK;
    m[4] = ROD_INERTIA + (0.25 * ROD_MASS + SLIDER_MASS) * ROD * ROD;
    m[8] = SLIDER_INERTIA;
    m[1] = m[3] = both;
    m[2] = m[5] = m[6] = m[7] = 0.0;
}

/* What gravity and the turning of crank and rod take, with Siconos' sign. */
void turning(unsigned n, const double *q, const double *v, double *f, unsigned k, double *z) {
    double turn = COUPLED * sin(q[1] - q[0]);
    f[0] = -turn * v[1] * v[1] + WEIGHT(CRANK_MASS, ROD_MASS + SLIDER_MASS) * CRANK * cos(q[0]);
    f[1] = turn * v[0] * v[0] + WEIGHT(ROD_MASS, SLIDER_MASS) * ROD * cos(q[1]);
    f[2] = 0.0;
}

static void gap(const double *q, double along, double face, double *y) {
    double height = CRANK * sin(q[0]) + ROD * sin(q[1]) + along * sin(q[2]);
    y[0] = HEIGHT + PLAY - face * height - HEIGHT * cos(q[2]);
    y[1] = 0.0;
}

static void rates(const double *q, double along, double face, double *w) { /* by columns */
    w[0] = -face * CRANK * cos(q[0]), w[1] = -CRANK * sin(q[0]);
    w[2] = -face * ROD * cos(q[1]), w[3] = -ROD * sin(q[1]);
    w[4] = -face * along * cos(q[2]) + HEIGHT * sin(q[2]);
    w[5] = -along * sin(q[2]) - face * HEIGHT * cos(q[2]);
}

#define CORNER(name, along, face)                                                                 \
    void name##_gap(unsigned n, const double *q, unsigned m, double *y, unsigned k, double *z) {  \
        gap(q, along, face, y);                                                                   \
    }                                                                                             \
    void name##_rates(unsigned n, const double *q, unsigned m, double *w, unsigned k, double *z) {\
        rates(q, along, face, w);                                                                 \
    }

CORNER(upper_behind, -HALF, 1.0)
CORNER(upper_ahead, HALF, 1.0)
CORNER(lower_behind, -HALF, -1.0)
CORNER(lower_ahead, HALF, -1.0)
