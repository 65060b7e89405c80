/* A ball with drag and Magnus force between a floor and a ceiling: what bench_throughput.py compares Integrated with.

   Tsit5 with Diffrax's tableau, interpolant, error norm, first step and step control. Each vector holds the same number
   of one ball per lane; a turn of the loop tries one step on every lane and, where it is accepted and the ball arrives,
   cuts it by Newton steps on the interpolant and bounces. Threads share the vectors. Neither drag nor lift may hold
   against gravity (z is concave), so that a floor is hit where a step ends below it, and a ceiling also within one;
   from the end and the start, Newton's steps then cannot pass the impact. It checks nothing: no resting ball, no
   input.

   numbers: see Numbers. On return the state at t1, or before impact number `limit` + 1, and the numbers of impacts. */

#include <stdint.h>

#include "lanes.h"

_Static_assert(sizeof(REAL) == 8, "float64 only: the tenth root reads its bits");

typedef int64_t whole __attribute__((vector_size(64)));
typedef struct { REAL low, high, g, drag, lift, restitution, grip, arm, twist, t1, tolerance; } Numbers;
typedef struct { vec x[3], v[3], spin[3]; } Ball;

static const REAL A[6][6] = {
    {0.161},
    {-0.0084806554923569887, 0.335480655492357},
    {2.8971530571054935, -6.3594484899750752, 4.3622954328695815},
    {5.3258648284392569, -11.748883564062828, 7.4955393428898365, -0.092495066361755252},
    {5.8614554429464203, -12.92096931784711, 8.1593678985761589, -0.071584973281400996, -0.028269050394068383},
    {0.09646076681806523, 0.01, 0.4798896504144996, 1.3790085741037419, -3.2900695154360808, 2.3247105240997739},
};
static const REAL ERROR[7] = {0.0017800110522257773, 0.00081643445965674626, -0.0078808780102619935,
                              0.14471100717326291,   -0.58235716545255523,   0.45808210592918686,
                              -0.015151515151515152};
/* Row j: what the interpolant's power j + 1 of the elapsed part of a step has of each stage. */
static const REAL INNER[4][7] = {
    {1, 0, 0, 0, 0, 0, 0},
    {-2.7637061972748258, 0.1317, 3.9302962368947512, -12.411077166933676, 37.50931341651104, -27.896526289197286, 1.5},
    {2.9132554618219126, -0.2234, -5.9410338721315048, 30.338188630282321, -88.178904894766404, 65.09189467479368, -4},
    {-1.0530884977290216, 0.1017, 2.490627285651253, -16.548102889244902, 47.37952196281928, -34.87065786149661, 2.5},
};

/* a to the power -1/10, to a few parts in 1e4: enough to choose a step. */
static inline vec inverse_tenth_root(vec a) {
    const int64_t one = 0x3FF0000000000000;
    a = most(least(a, all(1e14)), all(1e-14));
    vec bits = __builtin_convertvector((whole)a - one, vec);
    vec y = (vec)(__builtin_convertvector(bits * (REAL)-0.1, whole) + one);
    for (int i = 0; i < 3; i++) {
        vec y2 = y * y, y4 = y2 * y2;
        y *= (REAL)1.1 - (REAL)0.1 * a * y4 * y4 * y2;
    }
    return y;
}

static inline void accelerate(const Numbers *p, const vec v[3], const vec spin[3], vec a[3]) {
    vec slow = -p->drag * root(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]);
    for (int i = 0; i < 3; i++) {
        int j = (i + 1) % 3, l = (i + 2) % 3;
        a[i] = slow * v[i] + p->lift * (spin[j] * v[l] - spin[l] * v[j]);
    }
    a[2] -= p->g;
}

/* The squared error norm of parts of six, each relative to its tolerance. */
static inline vec mean_square(const vec parts[6], const vec scale[6]) {
    vec sum = all(0);
    for (int i = 0; i < 6; i++) {
        vec part = parts[i] / scale[i];
        sum += part * part;
    }
    return sum * (REAL)(1.0 / 6);
}

static vec first_step(const Numbers *p, const Ball *b, const vec a[3]) {
    vec scale[6], y[6], rate[6], change[6], v[3], later[3];
    for (int i = 0; i < 3; i++) y[i] = b->x[i], y[3 + i] = rate[i] = b->v[i], rate[3 + i] = a[i];
    for (int i = 0; i < 6; i++) scale[i] = p->tolerance + p->tolerance * size_of(y[i]);
    vec slope = root(mean_square(rate, scale)), h = (REAL)0.01 * root(mean_square(y, scale)) / slope;
    for (int i = 0; i < 3; i++) v[i] = b->v[i] + h * a[i];
    accelerate(p, v, b->spin, later);
    for (int i = 0; i < 3; i++) change[i] = h * a[i], change[3 + i] = later[i] - a[i];
    vec steepest = 100 * most(slope, root(mean_square(change, scale)) / h);
    return least(100 * h, inverse_tenth_root(steepest * steepest));
}

/* What part of the step passes until z is at `level`: on the interpolant, from its end at a floor. */
static vec arrival(vec z, const vec c[4], vec level, mask from_end, mask *hit) {
    vec s = only(from_end, all(1));
    for (int i = 0; i < 12; i++) {
        vec gap = z - level + s * (c[0] + s * (c[1] + s * (c[2] + s * c[3])));
        vec rate = c[0] + s * (2 * c[1] + s * (3 * c[2] + s * (4 * c[3])));
        *hit &= from_end | ((rate > 0) & (s <= 1));
        vec step = only(*hit, gap / rate);
        s -= step;
        if (!any(size_of(step) > (REAL)1e-9)) break; /* the next would be 1e-18 */
    }
    return s;
}

/* All of the step, or the part of it until the ball arrives, on lanes that do. */
static inline void
cut(Ball *to, const Ball *b, vec v[7][3], vec k[7][3], vec h, const Numbers *p, mask *hit, vec *part) {
    vec rise = h * b->v[2];
    mask falls = *hit & (to->x[2] < p->low);
    *hit &= falls | (to->x[2] > p->high) | ((b->v[2] > 0) & (to->v[2] < 0) & (b->x[2] + rise > p->high));
    if (!any(*hit)) return;
    vec c[4], level = pick(falls, all(p->low), all(p->high));
    for (int j = 0; j < 4; j++) {
        c[j] = all(0);
        for (int i = 0; i < 7; i++) c[j] += INNER[j][i] * v[i][2];
        c[j] *= h;
    }
    vec s = arrival(b->x[2], c, level, falls, hit);
    *part = pick(*hit, s, *part);
    vec weight[7];
    for (int i = 0; i < 7; i++) {
        weight[i] = h * s * (INNER[0][i] + s * (INNER[1][i] + s * (INNER[2][i] + s * INNER[3][i])));
    }
    for (int d = 0; d < 3; d++) {
        vec x = b->x[d], u = b->v[d];
        for (int i = 0; i < 7; i++) x += weight[i] * v[i][d], u += weight[i] * k[i][d];
        to->x[d] = pick(*hit, x, to->x[d]), to->v[d] = pick(*hit, u, to->v[d]);
    }
    to->x[2] = pick(*hit, level, to->x[2]);
}

static inline void kick(Ball *b, const Numbers *p, mask bounce) {
    vec side = pick(b->v[2] > 0, all(-1), all(1)), arm = side * p->arm, twist = only(bounce, side * p->twist);
    vec slip_x = b->v[0] - arm * b->spin[1], slip_y = b->v[1] + arm * b->spin[0], grip = only(bounce, all(p->grip));
    b->v[0] -= grip * slip_x, b->v[1] -= grip * slip_y;
    b->v[2] = pick(bounce, -p->restitution * b->v[2], b->v[2]);
    b->spin[0] -= twist * slip_y, b->spin[1] += twist * slip_x;
}

/* A step's stages, where it ends, and its squared error norm. */
static inline vec stepped(const Numbers *p, const Ball *b, vec h, vec v[7][3], vec k[7][3], Ball *to) {
    vec error[6], scale[6];
    for (int d = 0; d < 3; d++) v[0][d] = b->v[d];
    for (int i = 1; i < 7; i++) {
        for (int d = 0; d < 3; d++) {
            vec sum = A[i - 1][0] * k[0][d];
            for (int j = 1; j < i; j++) sum += A[i - 1][j] * k[j][d];
            v[i][d] = b->v[d] + h * sum;
        }
        accelerate(p, v[i], b->spin, k[i]);
    }
    *to = *b;
    for (int d = 0; d < 3; d++) {
        vec sum = all(0), off = all(0), turn = all(0);
        for (int i = 0; i < 6; i++) sum += A[5][i] * v[i][d];
        for (int i = 0; i < 7; i++) off += ERROR[i] * v[i][d], turn += ERROR[i] * k[i][d];
        to->x[d] = b->x[d] + h * sum, to->v[d] = v[6][d];
        error[d] = h * off, error[3 + d] = h * turn;
        scale[d] = p->tolerance + p->tolerance * most(size_of(b->x[d]), size_of(to->x[d]));
        scale[3 + d] = p->tolerance + p->tolerance * most(size_of(b->v[d]), size_of(to->v[d]));
    }
    return mean_square(error, scale);
}

static inline vec flown(Ball *b, const Numbers *p, int limit) {
    vec v[7][3], k[7][3], left = all(p->t1), count = all(0);
    mask alive = left > 0;
    accelerate(p, b->v, b->spin, k[0]);
    vec size = first_step(p, b, k[0]);
    while (any(alive)) {
        Ball to;
        vec h = least(size, left), square = stepped(p, b, h, v, k, &to), part = all(1);
        mask kept = square < 1, hit = alive & kept;
        vec factor = (REAL)0.9 * inverse_tenth_root(square);
        factor = pick(kept, most(least(factor, all(10)), all(1)), most(least(factor, all(0.9)), all(0.2)));
        size = pick(alive, h * factor, size);
        kept &= alive;
        mask ends = kept & (h >= left);
        cut(&to, b, v, k, h, p, &hit, &part);
        for (int d = 0; d < 3; d++) b->x[d] = pick(kept, to.x[d], b->x[d]), b->v[d] = pick(kept, to.v[d], b->v[d]);
        for (int d = 0; d < 3; d++) k[0][d] = pick(kept, k[6][d], k[0][d]);
        left -= only(kept, h * part);
        mask full = hit & (count >= (REAL)limit);
        alive &= ~((ends & ~hit) | full);
        if (any(hit)) {
            mask bounce = hit & ~full;
            kick(b, p, bounce);
            count += only(bounce, all(1));
            vec fresh[3];
            accelerate(p, b->v, b->spin, fresh);
            for (int d = 0; d < 3; d++) k[0][d] = pick(hit, fresh[d], k[0][d]);
        }
    }
    return count;
}

void run(const REAL *before, REAL *after, long n, const REAL *numbers, int limit) {
    const Numbers p = *(const Numbers *)numbers;
#pragma omp parallel for schedule(static, 16)
    for (long i = 0; i < n; i += LANES) {
        Ball b;
        for (int d = 0; d < 3; d++) b.x[d] = AT(before, d), b.v[d] = AT(before, 3 + d), b.spin[d] = AT(before, 6 + d);
        AT(after, 9) = flown(&b, &p, limit);
        for (int d = 0; d < 3; d++) AT(after, d) = b.x[d], AT(after, 3 + d) = b.v[d], AT(after, 6 + d) = b.spin[d];
    }
}
