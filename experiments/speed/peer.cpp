// The gait step of `peers` by hand: eight wheels side by side, adaptive explicit Runge-Kutta.
// METHOD holds the tableau: S stages, the last at the step's end; ONCE, TWICE: from accelerations
// to rates and positions; their errors; EXPONENT of step-size control. Three guards are watched.
#include <cmath>
#include METHOD

typedef double V __attribute__((vector_size(64)));
typedef long long M __attribute__((vector_size(64)));
static const int W = 8;

static inline V all(double x) { return V{} + x; }
static inline V pick(M m, V a, V b) { return (V)(((M)a & m) | ((M)b & ~m)); }
static inline V absolute(V x) { return pick(x < 0.0, -x, x); }
static inline V larger(V a, V b) { return pick(a > b, a, b); }
static inline bool any(M m) {
    long long r = 0;
    for (int i = 0; i < W; i++) r |= m[i];
    return r != 0;
}
// x to the power of `exponent`, right to 5e-4, for x from 1e-30: step-size control asks no more, and
// the library's powf is a call for each wheel.
typedef float F __attribute__((vector_size(32)));
typedef int I __attribute__((vector_size(32)));
static inline V power(V x, float exponent) {
    F y = __builtin_convertvector(x, F);
    I bits = (I)y, whole = (bits >> 23) - 127;
    F m = (F)((bits & 0x7fffff) | 0x3f800000);
    F log2 = __builtin_convertvector(whole, F)
             + (-2.496927f + m * (4.028742f + m * (-2.081385f + m * (0.628938f - m * 0.079167f))));
    F z = exponent * log2, floor = __builtin_convertvector(__builtin_convertvector(z + 64.0f, I), F) - 64.0f;
    F f = z - floor, e = 0.999813f + f * (0.696834f + f * (0.224131f + f * 0.079021f));
    F two = (F)((__builtin_convertvector(floor, I) + 127) << 23);
    return __builtin_convertvector(e * two, V);
}
// |x| below 1: to rounding by series.
static inline void sine_cosine(V x, V &s, V &c) {
    V y = x * x;
    s = x * (1 + y * (-1.0 / 6 + y * (1.0 / 120 + y * (-1.0 / 5040 + y * (1.0 / 362880 + y *
        (-1.0 / 39916800 + y * (1.0 / 6227020800.0 + y * (-1.0 / 1307674368000.0))))))));
    c = 1 + y * (-0.5 + y * (1.0 / 24 + y * (-1.0 / 720 + y * (1.0 / 40320 + y * (-1.0 / 3628800
        + y * (1.0 / 479001600 + y * (-1.0 / 87178291200.0 + y * (1.0 / 20922789888000.0))))))));
}

static const double SA = std::sqrt(0.5), CA = SA;
static const double HS = std::sin(0.125 * M_PI), HC = std::cos(0.125 * M_PI);  // half of an angle between legs

struct Wheel { V m, a, L0, Ls, k, c, g, sf, cf, Mh, D; };
struct Terms { V M11, M12, M13, f1, f2, f3; };

static inline Terms terms(V s, V co, V L1, V L2, V w, V v1, V v2, const Wheel &p) {
    V c0 = p.L0 - p.a, b = L2 - p.a, coupling = p.m * (c0 * (1 + CA) - b * CA);
    V P1 = p.Mh * L1 + coupling, P2 = p.m * (b - CA * L1);
    V sp = s * p.cf + co * p.sf, cp = co * p.cf - s * p.sf;
    V rsp = sp * CA + cp * SA, rcp = cp * CA - sp * SA;
    Terms t;
    t.M11 = L1 * (p.Mh * L1 + 2 * coupling) + p.m * (p.a * p.a + b * b + 6 * c0 * c0);
    t.M12 = p.m * SA * (L2 - p.L0);
    t.M13 = -p.m * SA * L1;
    t.f1 = p.g * ((p.Mh * L1 + p.m * p.L0) * sp + p.m * (p.L0 - L2) * rsp)
           - 2 * (P1 * v1 + P2 * v2) * w;
    t.f2 = p.k * (p.Ls - L1) - p.c * v1 + P1 * w * w - 2 * p.m * SA * w * v2 - p.g * p.Mh * cp;
    t.f3 = p.k * (p.Ls - L2) - p.c * v2 + P2 * w * w + 2 * p.m * SA * w * v1 + p.g * p.m * rcp;
    return t;
}

struct Double {
    static const int N = 1;
    static inline void at(const V *q, const V *v, const Wheel &p, V *x, V &guard, V &rate, V *legs) {
        V s, c, w = v[0], scale = p.D / SA;
        sine_cosine(q[0], s, c);
        V rs = s * CA + c * SA, rc = c * CA - s * SA;
        V L1 = scale * rc, L2 = scale * c, G1 = -scale * rs, G2 = -scale * s;
        // Over the bisector of the legs all is a trigonometric polynomial (docs/physics.md).
        V light = p.g * (p.Mh - p.m) * scale, swing = 2 * HC * p.m * (p.L0 - p.a) * scale, spring = p.k * scale;
        V leg = 2 * HC * p.g * p.m * p.L0, damper = p.c * scale * scale, c0 = p.L0 - p.a;
        V S = s * HC + c * HS, C = c * HC - s * HS, square = S * S;
        V inertia = scale * scale * (p.Mh - p.m) + p.m * (2 * p.a * p.a + 6 * c0 * c0) + 2 * swing * C;
        V turning = leg * p.cf - 2 * HC * p.Ls * spring + 2 * (CA * scale * spring + light * p.cf) * C
                    - 2 * light * p.sf * S + swing * w * w;
        V x1 = (light * p.sf + leg * p.sf * C + S * turning - ((1 - CA) * damper + 2 * CA * damper * square) * w)
               / inertia;
        Terms t = terms(s, c, L1, L2, w, G1 * w, G2 * w, p);
        V x2 = G1 * x1 - L1 * w * w, x3 = G2 * x1 - L2 * w * w;
        V r2 = t.M12 * x1 + p.Mh * x2 - p.m * CA * x3 - t.f2;
        V r3 = t.M13 * x1 - p.m * CA * x2 + p.m * x3 - t.f3;
        x[0] = x1;
        guard = (rs * r2 + s * r3) / SA;
        rate = all(0);
        if (legs) { legs[0] = L1; legs[1] = L2; legs[2] = G1 * w; legs[3] = G2 * w; }
    }
};

struct Single1 {
    static const int N = 3;
    static inline void at(const V *q, const V *v, const Wheel &p, V *x, V &guard, V &rate, V *) {
        V s, c;
        sine_cosine(q[0], s, c);
        Terms t = terms(s, c, q[1], q[2], v[0], v[1], v[2], p);
        V u = SA * q[1], A11 = t.M11 + t.M13 * u, A12 = t.M12 + t.M13 * CA;
        V A22 = p.Mh - p.m * CA * CA, F1 = t.f1 + u * t.f3, F2 = t.f2 + CA * t.f3;
        V r = 1 / (A11 * A22 - A12 * A12);
        x[0] = (A22 * F1 - A12 * F2) * r;
        x[1] = (A11 * F2 - A12 * F1) * r;
        x[2] = t.f3 / p.m + u * x[0] + CA * x[1];
        guard = p.L0 - q[2];
        rate = -v[2];
    }
};

struct Single2 {
    static const int N = 2;
    static inline void at(const V *q, const V *v, const Wheel &p, V *x, V &guard, V &rate, V *) {
        V s, c;
        sine_cosine(q[0], s, c);
        Terms t = terms(s, c, q[1], p.L0, v[0], v[1], all(0), p);
        x[0] = t.f1 / t.M11;
        x[1] = t.f2 / p.Mh;
        guard = q[1] * c - p.L0 * (c * CA + s * SA);
        rate = v[1] * c - q[1] * s * v[0] - p.L0 * v[0] * (c * SA - s * CA);
    }
};

template <class P> struct Step {
    V x[S][P::N], q[P::N], v[P::N], guard, rate;

    // From (q0, v0), whose slope is x[0], over h.
    inline void take(const V *q0, const V *v0, V h, const Wheel &p) {
        V hh = h * h, other, unused;
#pragma GCC unroll 16
        for (int i = 1; i < S; i++) {
            for (int d = 0; d < P::N; d++) {
                V a = all(0), b = all(0);
#pragma GCC unroll 16
                for (int j = 0; j < i; j++) {
                    if (ONCE[i][j] != 0) a += ONCE[i][j] * x[j][d];
                    if (TWICE[i][j] != 0) b += TWICE[i][j] * x[j][d];
                }
                v[d] = v0[d] + h * a;
                q[d] = q0[d] + h * PLACES[i] * v0[d] + hh * b;
            }
            if (i < S - 1) P::at(q, v, p, x[i], other, unused, nullptr);
            else P::at(q, v, p, x[i], guard, rate, nullptr);
        }
    }
};

// To the guard: state in place, time in `time`, the next step in h.
template <class P> static void phase(V *q, V *v, V &h, V &time, const Wheel &p, double tol) {
    Step<P> step;
    V before, rate;
    P::at(q, v, p, step.x[0], before, rate, nullptr);
    M marching = all(0) == 0.0;
    time = all(0);
    for (int tries = 0; tries < 4096 && any(marching); tries++) {
        step.take(q, v, h, p);
        V total = all(0);
        for (int d = 0; d < P::N; d++) {
            V a = all(0), b = all(0);
#pragma GCC unroll 16
            for (int j = 0; j < S; j++) {
                if (ERROR_ONCE[j] != 0) a += ERROR_ONCE[j] * step.x[j][d];
                if (ERROR_TWICE[j] != 0) b += ERROR_TWICE[j] * step.x[j][d];
            }
            V e = h * a / (tol + tol * larger(absolute(v[d]), absolute(step.v[d])));
            V f = h * h * b / (tol + tol * larger(absolute(q[d]), absolute(step.q[d])));
            total += e * e + f * f;
        }
        total = total / (2.0 * P::N);
        M good = marching & (total <= 1.0);
        M crossed = good & (step.guard <= 0.0), on = good & ~(step.guard <= 0.0);
        for (int d = 0; d < P::N; d++) {
            q[d] = pick(on, step.q[d], q[d]);
            v[d] = pick(on, step.v[d], v[d]);
            step.x[0][d] = pick(on, step.x[S - 1][d], step.x[0][d]);
        }
        before = pick(on, step.guard, before);
        rate = pick(crossed, step.guard, rate);  // kept for the first guess
        time += pick(on, h, all(0));
        V change = 0.9 * power(total + 1e-30, EXPONENT);
        change = larger(all(0.2), pick(change < 5.0, change, all(5.0)));
        marching &= ~crossed;
        h = pick(marching, h * change, h);
    }
    V low = all(0), high = h, x0 = all(0), g0 = before, d = h * before / (before - rate), change;
    M open = all(0) == 0.0;
    V end_q[P::N], end_v[P::N], length = d;
    for (int tries = 0; tries < 30 && any(open); tries++) {
        step.take(q, v, d, p);
        V g = step.guard, slope = pick(step.rate == 0.0, (g - g0) / (d - x0), step.rate);
        change = -g / slope;
        M near = open & (absolute(change) < 1e-8 * h);
        for (int i = 0; i < P::N; i++) {
            end_q[i] = pick(near, step.q[i] + change * step.v[i], end_q[i]);
            end_v[i] = pick(near, step.v[i] + change * step.x[S - 1][i], end_v[i]);
        }
        length = pick(near, d + change, length);
        open &= ~near;
        low = pick(g > 0.0, d, low);
        high = pick(g > 0.0, high, d);
        x0 = d;
        g0 = g;
        V next = d + change;
        d = pick((next > low) & (next < high), next, 0.5 * (low + high));
    }
    for (int i = 0; i < P::N; i++) { q[i] = end_q[i]; v[i] = end_v[i]; }
    time += length;
}

// parameters (10, lanes), starts (2, lanes) -> told (6, lanes); lanes a multiple of 8.
extern "C" void steps(const double *parameters, const double *starts, double *told, long lanes, double tol) {
    for (long at = 0; at < lanes; at += W) {
        Wheel p;
        V *fields = (V *)&p;
        for (int i = 0; i < 10; i++) __builtin_memcpy(&fields[i], parameters + i * lanes + at, 64);
        V q[3], v[3], h = all(5e-3), time[3], s, c, legs[4], x[3], guard, rate;
        __builtin_memcpy(&q[0], starts + at, 64);
        __builtin_memcpy(&v[0], starts + lanes + at, 64);
        sine_cosine(q[0], s, c);
        p.D = p.L0 * SA / (c * CA - s * SA);
        phase<Double>(q, v, h, time[0], p, tol);
        Double::at(q, v, p, x, guard, rate, legs);
        q[1] = legs[0]; q[2] = legs[1]; v[1] = legs[2]; v[2] = legs[3];
        V fast = 7.0 * std::pow(tol, -2.0 * EXPONENT) * p.m / p.c;  // the airborne leg's mode
        h = pick(0.3 * h < fast, 0.3 * h, fast);
        phase<Single1>(q, v, h, time[1], p, tol);
        Terms t = terms(all(0), all(1), q[1], p.L0, all(0), all(0), all(0), p);
        v[0] -= p.m * SA * q[1] * v[2] / t.M11;
        v[1] -= p.m * CA * v[2] / p.Mh;
        phase<Single2>(q, v, h, time[2], p, tol);
        V out[6] = {q[0], v[0], v[1], time[0], time[1], time[2]};
        for (int i = 0; i < 6; i++) __builtin_memcpy(told + i * lanes + at, &out[i], 64);
    }
}
