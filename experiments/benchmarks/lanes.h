/* Whole vectors of REAL, one ball a lane: what the C programs beside bench_throughput.py share.

   Each has run(before, after, n, numbers, limit). `before` holds position, velocity and spin, nine columns of n
   numbers, aligned to 64 bytes, n a multiple of LANES; `after` the same and one column more. */

#include <math.h>

#ifndef REAL
#define REAL double
#endif
#define LANES (64 / sizeof(REAL))

typedef REAL vec __attribute__((vector_size(64)));
typedef __typeof__((vec){0} < (vec){0}) mask;

#define AT(data, j) (*(vec *)((data) + (j) * n + i)) /* lanes i and up of column j */

static inline vec pick(mask m, vec a, vec b) { return (vec)((m & (mask)a) | (~m & (mask)b)); }
static inline vec only(mask m, vec a) { return (vec)(m & (mask)a); }
static inline vec all(REAL x) { return (vec){0} + x; }
static inline mask none(void) { return all(0) != all(0); }
static inline vec size_of(vec a) { return pick(a < 0, -a, a); }

#ifdef __AVX512F__
#include <immintrin.h>
static inline vec root(vec a) {
    return sizeof(REAL) == 4 ? (vec)_mm512_sqrt_ps((__m512)a) : (vec)_mm512_sqrt_pd((__m512d)a);
}
static inline vec least(vec a, vec b) {
    return sizeof(REAL) == 4 ? (vec)_mm512_min_ps((__m512)a, (__m512)b) : (vec)_mm512_min_pd((__m512d)a, (__m512d)b);
}
static inline vec most(vec a, vec b) {
    return sizeof(REAL) == 4 ? (vec)_mm512_max_ps((__m512)a, (__m512)b) : (vec)_mm512_max_pd((__m512d)a, (__m512d)b);
}
static inline int any(mask m) { return _mm512_test_epi64_mask((__m512i)m, (__m512i)m) != 0; }
#else
static inline vec root(vec a) {
    vec r;
    for (unsigned i = 0; i < LANES; i++) r[i] = sizeof(REAL) == 4 ? sqrtf(a[i]) : sqrt(a[i]);
    return r;
}
static inline vec least(vec a, vec b) { return pick(a < b, a, b); }
static inline vec most(vec a, vec b) { return pick(a > b, a, b); }
static inline int any(mask m) {
    int found = 0;
    for (unsigned i = 0; i < LANES; i++) found |= m[i] != 0;
    return found;
}
#endif
