/* A rough elastic ball between a floor and a ceiling: the limit that bench_throughput.py compares with.

   Each vector holds the same number of one ball per lane; a ball's ten numbers stay in registers for all its bounces, and
   threads share the balls. It knows the scene (horizontal planes, one law, no spin about z) and checks nothing: no corner,
   no resting ball, no end of time, no input.

   state: x y z, velocity, spin, each n numbers long and aligned to 64 bytes; n a multiple of LANES. On return the state on
   arrival at impact number `bounces` + 1, before it, and in `time` when that is. */

#include <math.h>

#ifndef REAL
#define REAL float
#endif
#define LANES (64 / sizeof(REAL))

typedef REAL vec __attribute__((vector_size(64)));
typedef __typeof__((vec){0} < (vec){0}) mask;

static inline vec pick(mask m, vec a, vec b) { return (vec)((m & (mask)a) | (~m & (mask)b)); }

#ifdef __AVX512F__
#include <immintrin.h>
static inline vec root(vec a) {
    return sizeof(REAL) == 4 ? (vec)_mm512_sqrt_ps((__m512)a) : (vec)_mm512_sqrt_pd((__m512d)a);
}
#else
static inline vec root(vec a) {
    vec r;
    for (unsigned i = 0; i < LANES; i++) r[i] = sizeof(REAL) == 4 ? sqrtf(a[i]) : sqrt(a[i]);
    return r;
}
#endif

void run(REAL *state, REAL *time, long n, int bounces, REAL height, REAL radius, REAL g, REAL alpha) {
    const REAL k = 2 * alpha / (1 + alpha), twist = k / (alpha * radius), low = radius, high = height - radius;
#define COLUMN(j) (*(vec *)(state + (j) * n + i))
#pragma omp parallel for schedule(static)
    for (long i = 0; i < n; i += LANES) {
        vec x = COLUMN(0), y = COLUMN(1), z = COLUMN(2), u = COLUMN(3), v = COLUMN(4), w = COLUMN(5);
        vec a = COLUMN(6), b = COLUMN(7), t = {0};
        for (int j = 0;; j++) {
            vec up = z - low, down = high - z, square = w * w - 2 * g * down;
            mask above = (w > 0) & (square > 0); /* it reaches the ceiling first */
            vec to_ceiling = 2 * down / (w + root(square)), to_floor = (w + root(w * w + 2 * g * up)) / g;
            vec h = pick(above, to_ceiling, to_floor);
            z = pick(above, (vec){0} + high, (vec){0} + low);
            x += u * h, y += v * h, w -= g * h, t += h;
            if (j == bounces) break;
            vec arm = pick(above, (vec){0} - radius, (vec){0} + radius);
            vec turn = pick(above, (vec){0} - twist, (vec){0} + twist);
            vec slip_x = u - arm * b, slip_y = v + arm * a;
            w = -w, u -= k * slip_x, v -= k * slip_y, a -= turn * slip_y, b += turn * slip_x;
        }
        COLUMN(0) = x, COLUMN(1) = y, COLUMN(2) = z, COLUMN(3) = u, COLUMN(4) = v, COLUMN(5) = w;
        COLUMN(6) = a, COLUMN(7) = b, *(vec *)(time + i) = t;
    }
}
