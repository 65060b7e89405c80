/* A rough elastic ball on a floor and a table with edges and corners: what bench_throughput.py compares with.

   Each vector holds the same number of one ball per lane, and threads share the vectors. A ball touches the table where
   its centre reaches a box with rounded edges and corners. That lies in a box with sharp ones, and a parabola is in the
   latter during at most two stretches of time, on its way up and on its way down, in closed form. Most flights have
   none, or enter through a face where it is both boxes' face: that is the impact. The others look for it by steps that
   cannot pass it, from a bound of the second derivative of the squared distance.

   It knows the scene (one law, elastic, a box along the axes, gravity along z) and checks nothing: no resting ball, no
   corner between surfaces, no input.

   numbers: a Scene as below, t1. On return the state at t1, or before impact number `limit` + 1, and the numbers of
   impacts. */

#include <float.h>

#include "lanes.h"

#define EPS (sizeof(REAL) == 4 ? (REAL)FLT_EPSILON : (REAL)DBL_EPSILON)
enum { X, Y, Z };

typedef struct { REAL radius, g, alpha, center[3], half[3]; } Scene;
typedef struct { vec x[3], v[3], spin[3]; } Ball;
typedef struct { vec from, to; } Stretch;

static inline void along(const Ball *b, REAL g, vec t, vec x[3]) {
    x[X] = b->x[X] + b->v[X] * t, x[Y] = b->x[Y] + b->v[Y] * t;
    x[Z] = b->x[Z] + (b->v[Z] - all(g / 2) * t) * t;
}

/* When a straight coordinate is within +-width. */
static inline Stretch straight(vec x, vec v, REAL width) {
    vec inverse = 1 / v, one = (-width - x) * inverse, other = (width - x) * inverse;
    return (Stretch){least(one, other), most(one, other)};
}

/* When z is above `level`; nothing to be read where `square`, of its speed there, is negative. */
static inline Stretch above(vec z, vec w, REAL g, REAL level, vec *square) {
    vec up = z - level;
    *square = w * w + 2 * g * up;
    vec far = size_of(w) + root(most(*square, all(0))), early = -2 * up / far, late = far * (1 / g);
    mask rises = w >= 0;
    return (Stretch){pick(rises, early, -late), pick(rises, late, -early)};
}

/* The first zero of the squared distance to the core less r^2 within a stretch, on lanes that `may`. */
static __attribute__((noinline)) mask
search(const Ball *b, const Scene *s, Stretch in, mask may, mask touching, vec *hit) {
    const REAL r = s->radius, bend = 2 * r * s->g, near = 4 * EPS * r;
    vec t = in.from;
    mask found = none();
    for (int turn = 0; turn < 64 && any(may); turn++) {
        vec x[3], level = all(-r * r), rate = all(0), speed[3] = {b->v[X], b->v[Y], b->v[Z] - s->g * t};
        along(b, s->g, t, x);
        for (int i = 0; i < 3; i++) {
            vec beyond = most(size_of(x[i]) - s->half[i], all(0));
            level += beyond * beyond;
            rate += 2 * beyond * pick(x[i] < 0, -speed[i], speed[i]);
        }
        if (turn == 0) level = pick(touching & (t <= 0), all(0), level); /* it starts in contact */
        vec edge = root(most(rate * rate + 2 * bend * level, all(0)));
        mask here = may & (level <= near) & (rate < 0), closes = rate < 0;
        found |= here;
        *hit = pick(here, t - level / rate, *hit);
        may &= ~here;
        t = pick(may, t + pick(closes, 2 * level, rate + edge) / pick(closes, edge - rate, all(bend)), t);
        may &= t < in.to;
    }
    return found;
}

/* The first impact on the table before `until`; by which face, 1 to 3, or 0 for an edge or a corner. */
static inline mask strikes(const Ball *b, const Scene *s, vec until, mask alive, mask touching, vec *hit, vec *face) {
    const REAL r = s->radius, *half = s->half, width[3] = {half[X] + r, half[Y] + r, half[Z] + r};
    vec apex, low;
    Stretch x = straight(b->x[X], b->v[X], width[X]), y = straight(b->x[Y], b->v[Y], width[Y]);
    Stretch up = above(b->x[Z], b->v[Z], s->g, -width[Z], &low), top = above(b->x[Z], b->v[Z], s->g, width[Z], &apex);
    vec from = most(most(x.from, y.from), all(0)), to = least(least(x.to, y.to), until);
    mask over = apex > 0, found = none();
    alive &= (low > 0) & (from < to);
    Stretch ways[2] = {{up.from, pick(over, top.from, up.to)}, {pick(over, top.to, to), up.to}};
    for (int way = 0; way < 2; way++) {
        Stretch in = {most(from, ways[way].from), least(to, ways[way].to)};
        mask may = alive & ~found & (in.from < in.to);
        if (!any(may)) continue;
        vec at[3];
        along(b, s->g, in.from, at);
        mask within[3], comes = may & (in.from > 0);
        for (int i = 0; i < 3; i++) within[i] = size_of(at[i]) <= half[i];
        mask by_x = comes & (in.from == x.from) & within[Y] & within[Z];
        mask by_y = comes & (in.from == y.from) & within[X] & within[Z];
        mask by_z = comes & (in.from == ways[way].from) & within[X] & within[Y];
        mask by_face = by_x | by_y | by_z;
        *hit = pick(by_face, in.from, *hit);
        *face = pick(by_x, all(1), pick(by_y, all(2), pick(by_z, all(3), *face)));
        found |= by_face;
        may &= ~by_face;
        if (any(may)) found |= search(b, s, in, may, touching, hit);
    }
    return found;
}

/* The rough elastic impact on lanes that `bounce`, with the normal n. */
static inline void kick(Ball *b, REAL k, REAL r, REAL alpha, const vec n[3], mask bounce) {
    vec slip[3], speed = only(bounce, b->v[X] * n[X] + b->v[Y] * n[Y] + b->v[Z] * n[Z]);
    for (int i = 0; i < 3; i++) {
        int j = (i + 1) % 3, l = (i + 2) % 3;
        vec turning = b->spin[j] * n[l] - b->spin[l] * n[j];
        slip[i] = only(bounce, b->v[i] - speed * n[i] - r * turning);
    }
    for (int i = 0; i < 3; i++) {
        int j = (i + 1) % 3, l = (i + 2) % 3;
        b->v[i] -= 2 * speed * n[i] + k * slip[i];
        b->spin[i] += k / (alpha * r) * (n[j] * slip[l] - n[l] * slip[j]);
    }
}

/* Every lane's ball to its end; the numbers of impacts. */
static inline vec flown(Ball *b, const Scene *s, int limit, REAL t1) {
    const REAL g = s->g, r = s->radius, low = r - s->center[Z], k = 2 * s->alpha / (1 + s->alpha);
    vec left = all(t1), count = all(0), square;
    mask alive = left >= 0, touching = none();
    while (any(alive)) {
        vec h = least(above(b->x[Z], b->v[Z], g, low, &square).to, left), face = all(0);
        mask on_table = strikes(b, s, h, alive, touching, &h, &face);
        mask over = (h >= left) & ~on_table, full = count >= (REAL)limit, bounce = alive & ~over & ~full;
        h = only(alive, h);
        vec n[3] = {all(0), all(0), all(1)};
        along(b, g, h, b->x);
        b->v[Z] -= g * h, left -= h;
        b->x[Z] = pick(alive & ~over & ~on_table, all(low), b->x[Z]);
        if (any(on_table)) {
            vec beyond[3], square = all(0);
            for (int i = 0; i < 3; i++) {
                vec edge = pick(b->x[i] < 0, all(-s->half[i]), all(s->half[i]));
                mask flat = on_table & (face == (REAL)(i + 1));
                b->x[i] = pick(flat, pick(edge < 0, edge - r, edge + r), b->x[i]);
                beyond[i] = pick(size_of(b->x[i]) > s->half[i], b->x[i] - edge, all(0));
                square += beyond[i] * beyond[i];
            }
            vec scale = 1 / root(square);
            for (int i = 0; i < 3; i++) n[i] = pick(on_table, beyond[i] * scale, n[i]);
        }
        kick(b, k, r, s->alpha, n, bounce);
        count += only(bounce, all(1));
        touching = on_table & (face == 0);
        alive = bounce;
    }
    return count;
}

void run(const REAL *before, REAL *after, long n, const REAL *numbers, int limit) {
    const Scene *s = (const Scene *)numbers;
    const REAL t1 = numbers[sizeof(Scene) / sizeof(REAL)];
#pragma omp parallel for schedule(static, 64)
    for (long i = 0; i < n; i += LANES) {
        Ball b;
        for (int j = 0; j < 3; j++) {
            b.x[j] = AT(before, j) - s->center[j], b.v[j] = AT(before, 3 + j), b.spin[j] = AT(before, 6 + j);
        }
        AT(after, 9) = flown(&b, s, limit, t1);
        for (int j = 0; j < 3; j++) {
            AT(after, j) = b.x[j] + s->center[j], AT(after, 3 + j) = b.v[j], AT(after, 6 + j) = b.spin[j];
        }
    }
}
