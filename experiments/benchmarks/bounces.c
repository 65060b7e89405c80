/* A rough elastic ball between a floor and a ceiling: the limit that bench_throughput.py compares with.

   Each vector holds the same number of one ball per lane; a ball's ten numbers stay in registers for all its bounces,
   and threads share the balls. It knows the scene (horizontal planes, one law, no spin about z) and checks nothing: no
   corner, no resting ball, no end of time, no input.

   numbers: height, radius, gravity, inertia ratio. On return the state on arrival at impact number `limit` + 1, before
   it, and when that is. */

#include "lanes.h"

void run(const REAL *before, REAL *after, long n, const REAL *numbers, int limit) {
    const REAL height = numbers[0], radius = numbers[1], g = numbers[2], alpha = numbers[3];
    const REAL k = 2 * alpha / (1 + alpha), twist = k / (alpha * radius), low = radius, high = height - radius;
#pragma omp parallel for schedule(static)
    for (long i = 0; i < n; i += LANES) {
        vec x = AT(before, 0), y = AT(before, 1), z = AT(before, 2), u = AT(before, 3), v = AT(before, 4);
        vec w = AT(before, 5), a = AT(before, 6), b = AT(before, 7), t = {0};
        for (int j = 0;; j++) {
            vec up = z - low, down = high - z, square = w * w - 2 * g * down;
            mask above = (w > 0) & (square > 0); /* it reaches the ceiling first */
            vec to_ceiling = 2 * down / (w + root(square)), to_floor = (w + root(w * w + 2 * g * up)) / g;
            vec h = pick(above, to_ceiling, to_floor);
            z = pick(above, all(high), all(low));
            x += u * h, y += v * h, w -= g * h, t += h;
            if (j == limit) break;
            vec arm = pick(above, all(-radius), all(radius));
            vec turn = pick(above, all(-twist), all(twist));
            vec slip_x = u - arm * b, slip_y = v + arm * a;
            w = -w, u -= k * slip_x, v -= k * slip_y, a -= turn * slip_y, b += turn * slip_x;
        }
        AT(after, 0) = x, AT(after, 1) = y, AT(after, 2) = z, AT(after, 3) = u, AT(after, 4) = v, AT(after, 5) = w;
        AT(after, 6) = a, AT(after, 7) = b, AT(after, 8) = AT(before, 8), AT(after, 9) = t;
    }
}
