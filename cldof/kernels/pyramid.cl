/* pyramid.cl: cull, disocclude, matte, blur and blend the sub-images of one RGBZ image.
 *
 * source  Kraus & Strengert 2007, "Depth-of-Field Rendering by Pyramidal Image Processing"; docs/methods/pyramid.md
 *
 * A stack of RGBZ images is float[sources][height][pitch][4] and float[sources][height][pitch]: colour with 1 in the
 * alpha channel, inverse depth (1/m; EMPTY is a hole), pitch a multiple of 16. Source s is what is seen when the peels
 * before s are taken away.
 *
 * A sub-image reaches `margin` pixels beyond the frame on each side; what is out there is unknown and gets filled like
 * any hole. It is blurred by `steps` reductions and as many expansions. Its pyramids start at level 1: level 0, as
 * large as the sub-image, is computed where it is needed and never stored. All levels of all sub-images lie in one
 * buffer, float[][4] for colour and float[] for inverse depth, described by a table int4[sub-images][PYRAMID_LEVELS]:
 *   entry 0   (margin, steps, width, height of level 0), in px; margin a multiple of 16 and of 2^steps
 *   entry k   (offset of the first pixel, width, height, pitch), in px; level k is half as large as level k - 1,
 *             rounded up; the first `steps` halvings are even; the pitch is a multiple of 16
 *
 * Kernels over sub-images have the range (items per row, sub-images, rows): an item takes every get_global_size(0)-th
 * block of its row. Rows are numbered so that the same one shows the same part of the frame in all sub-images, which
 * follow each other closely and find it in the cache. */

#include "slots.clh"

#define PYRAMID_LEVELS 16
/* The most sub-images. */
#define PYRAMID_COUNT 24
/* Rows of level 1 that a work-group of pyramid_matte makes. */
#define PYRAMID_ROWS 8
/* Below this coverage the result is 0 rather than a quotient of rounding errors. */
#define PYRAMID_MIN_COVERAGE 1e-4f

/* What slots one and two sigma around count for in a surface's breadth; the rest is the pixel's own. Beside a straight
 * edge that makes 0.64, 0.79, 0.87, 0.96 and 1 up to 0.7, 1, 1.4, 2 and past 2 sigma from it; a Gaussian leaves 0.76,
 * 0.84, 0.92, 0.98 at these distances. It must be 1 only where next to nothing is lost: a surface of breadth 1 leaves a
 * sub-image at once when focus passes. */
#define PYRAMID_NEAR_RING 0.6f
#define PYRAMID_FAR_RING 0.35f

/* 1: matting functions as published, linear in z. 0: linear in the CoC, entered early only where a surface slopes. */
#ifndef PYRAMID_PAPER
#define PYRAMID_PAPER 0
#endif
/* 1: where nothing is, there is void at infinity. 0: a hole. */
#ifndef PYRAMID_VOID
#define PYRAMID_VOID 0
#endif
/* What the alpha channel of a flattened image holds. 0: coverage. 1: coverage, and red is alpha, for the second run
 * over a frame that is not opaque; it completes the image of the first. 2: the true alpha. */
#ifndef PYRAMID_ALPHA
#define PYRAMID_ALPHA 0
#endif
/* 1: divide the blended image by its coverage. */
#ifndef PYRAMID_DIVIDE
#define PYRAMID_DIVIDE 1
#endif

typedef struct {
    int width, height, pitch; /* of the frame, guard band included */
    int peels, sources;
    int top; /* the largest margin */
    int guard;
} PyramidSize;

/* Matting functions, per sub-image (up scale, up offset, down scale, down offset): with t the inverse depth, or the
 * depth if PYRAMID_PAPER, clamp(t * scale + offset, 0, 1) is the front and the back ramp. `before`: the back ramp of the
 * sub-image before, zeros for the first. `seam`: per unit of slope (1/m per px), the part of the front ramp that a
 * surface needs to close the seam to the sub-image before. `around`: px, about one sigma of the blur. */
typedef struct {
    float4 ramp[PYRAMID_COUNT];
    float2 before[PYRAMID_COUNT];
    float seam[PYRAMID_COUNT];
    int around[PYRAMID_COUNT];
} PyramidMatting;

/* pyramid_matting: the frame's matting functions as a buffer. Mesa 22.3 ends the process in kernels that take a struct
 * with an array by value and look an element up in it.
 * writes  matting  PyramidMatting
 * range   1-D, one item */
__kernel void pyramid_matting(__global PyramidMatting *matting, PyramidMatting given) { *matting = given; }

/* What one sub-image needs of that. */
typedef struct {
    float4 ramp;
    float2 before;
    float seam;
} PyramidRamps;

static inline PyramidRamps ramps_of(const __global PyramidMatting *matting, int i)
{
    PyramidRamps ramps = {matting->ramp[i], matting->before[i], matting->seam[i]};
    return ramps;
}

typedef float8 __attribute__((aligned(4))) float8_unaligned;

static inline float8 load_eight(const __global float *p) { return *(const __global float8_unaligned *)p; }
static inline void store_four(__global float *p, float4 v) { *(__global float4_unaligned *)p = v; }

static inline float sum4(float4 v) { return (v.x + v.y) + (v.z + v.w); }

/* How many of 16 pixels are holes. */
static inline float count_holes(float16 w) { return sum16(w < 0.0f ? (float16)(1.0f) : (float16)(0.0f)); }

static inline float greatest(float16 v)
{
    float8 a = v.lo > v.hi ? v.lo : v.hi;
    float4 b = a.lo > a.hi ? a.lo : a.hi;
    float2 c = b.lo > b.hi ? b.lo : b.hi;
    return c.x > c.y ? c.x : c.y;
}

static inline float least(float16 v) { return -greatest(-v); }

/* Four quads of a float16, by index. */
static inline float4 part(float16 v, int q)
{
    float8 half_ = q & 2 ? v.hi : v.lo;
    return q & 1 ? half_.hi : half_.lo;
}

/* pyramid_flatten: what is seen from each source on, as an opaque RGBZ image.
 * reads   color      float[peels][height][width][4]
 *         inv_depth  float[peels][height][pitch]  1/m
 * writes  flat       float[sources][height][pitch][4]  0 in holes and past the row
 *         flat_inv   float[sources][height][pitch]     1/m, of the peel with which half of the pixel is covered
 * range   2-D: (items per row, sources * height), any local size; an item takes every get_global_size(0)-th quad */
__kernel void pyramid_flatten(__global float *restrict flat, __global float *restrict flat_inv,
                              const __global float *restrict color, const __global float *restrict inv_depth,
                              PyramidSize size)
{
    const int row = get_global_id(1);
    const int source = row / size.height, y = row % size.height;
    for (int x = 4 * get_global_id(0); x < size.pitch; x += 4 * get_global_size(0)) {
        const int n = size.width - x;
        float16 image = (float16)(0.0f);
        float4 depth = (float4)(EMPTY), nearest = (float4)(EMPTY);
        for (int m = source; m < size.peels && n > 0; m++) {
            const size_t at = (size_t)m * size.height + y;
            const __global float *rgba = color + (at * size.width + x) * 4;
            float4 w = load_pixel(inv_depth + at * size.pitch + x);
            if (w.x < 0.0f && w.y < 0.0f && w.z < 0.0f && w.w < 0.0f) continue;
            float16 c = n >= 4 ? load_quad(rgba) : load_quad_part(rgba, n);
            int4 there = (w >= 0.0f) & (c.s37bf > 0.0f);
            image += (1.0f - image.s33337777bbbbffff) * c;
            float4 alpha = image.s37bf;
            nearest = ((nearest < 0.0f) & there) ? w : nearest;
            depth = ((depth < 0.0f) & there & (alpha >= 0.5f)) ? w : depth;
            if (alpha.x >= 1.0f && alpha.y >= 1.0f && alpha.z >= 1.0f && alpha.w >= 1.0f) break;
        }
        const int4 inside = (int4)(0, 1, 2, 3) < n;
        float4 alpha = image.s37bf;
#if PYRAMID_VOID
        float4 known = (float4)(1.0f);
        depth = depth < 0.0f ? nearest : depth;
        depth = depth < 0.0f ? (float4)(0.0f) : depth;
        depth = inside ? depth : (float4)(EMPTY);
#else
        int4 is_known = (alpha >= 0.5f) & inside;
        float4 known = is_known ? (float4)(1.0f) : (float4)(0.0f);
        image *= spread(is_known ? 1.0f / alpha : (float4)(0.0f));
        depth = is_known ? depth : (float4)(EMPTY);
#endif
#if PYRAMID_ALPHA == 0
        image.s37bf = known;
#elif PYRAMID_ALPHA == 1
        const float16 red = (float16)(1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0);
        image = image.s33337777bbbbffff * red;
        image.s37bf = known;
#endif
        const size_t to = (size_t)row * size.pitch + x;
        store_quad(flat + to * 4, image * spread(inside ? (float4)(1.0f) : (float4)(0.0f)));
        store_four(flat_inv + to, depth);
    }
}

/* pyramid_slope: change of inverse depth from one pixel to the next, the lesser of both sides, so that a silhouette
 * does not count as a slope, and the greater of both directions; and how much of a visible surface is left around it
 * when it is blurred.
 * reads   flat_inv  float[sources][height][pitch]  1/m
 *         matting   PyramidMatting
 * writes  slope     float[sources][height][pitch]  1/m per px; 0 where no neighbour is known; anything in holes
 *         broad     float[height][pitch]  share of a blur's weight around a pixel that belongs to the surface of source
 *                   0 or hides it; 1 in front of the first sub-image and behind the last
 *         span      float[sources][height][pitch / 16][2]  1/m; of each block the nearest slot, EMPTY if all are holes,
 *                   and the farthest, or EMPTY minus it if there are holes
 * range   2-D: (items per row, sources * height), any local size; an item takes every get_global_size(0)-th block */
__kernel void pyramid_slope(__global float *restrict slope, __global float *restrict broad,
                            __global float *restrict span, const __global float *restrict flat_inv,
                            const __global PyramidMatting *restrict matting, PyramidSize size, int count)
{
    const int row = get_global_id(1), y = row % size.height;
    for (int x = 16 * get_global_id(0); x < size.pitch; x += 16 * get_global_size(0)) {
        const __global float *inv = flat_inv + (size_t)row * size.pitch + x;
        const float16 w = load_quad(inv);
        store_quad(slope + (size_t)row * size.pitch + x, slope_of(inv, w, x, y, size.height, size.pitch, MAXFLOAT));
        const float nearest = greatest(w), holes = least(w);
        const float farthest = -greatest(w < 0.0f ? (float16)(-MAXFLOAT) : -w);
        __global float *to = span + ((size_t)row * size.pitch + x) / 8;
        to[0] = nearest;
        to[1] = holes < 0.0f ? EMPTY - farthest : farthest;
        if (row >= size.height) continue;
        float16 share = (float16)(1.0f);
        for (int i = 0; i < count; i++) {
            const float2 before = matting->before[i];
            if (before.x == 0.0f) continue;
            float16 rest = w * before.x + before.y;
            int16 is_own = (rest > 0.0f) & (rest <= 1.0f) & (w >= 0.0f);
            if (sum16(is_own ? (float16)(1.0f) : (float16)(0.0f)) == 0.0f) continue;
            const int around = matting->around[i], width = size.width, height = size.height, pitch = size.pitch;
            float16 near = breadth_of(flat_inv, w, x, y, width, height, pitch, around, before.x);
            float16 far = breadth_of(flat_inv, w, x, y, width, height, pitch, 2 * around, before.x);
            near = 1.0f - PYRAMID_NEAR_RING * (1.0f - near) - PYRAMID_FAR_RING * (1.0f - far);
            share = is_own ? near : share;
        }
        store_quad(broad + (size_t)row * size.pitch + x, share);
    }
}

/* --- matting (section 3.3) --- */

static inline float16 matting_axis(float16 w)
{
#if PYRAMID_PAPER
    return 1.0f / (w > 1e-20f ? w : (float16)(1e-20f));
#else
    return w;
#endif
}

/* Front ramp. Where it is 0 the pixel is culled as foreground.
 *
 * A pixel that is 1 - t in the sub-image before and t past it takes its full weight here where its surface is broad, or
 * what is behind would show through, and only a share where it is thin: of what blurs to little both would add up to
 * more than there is. With b the breadth, t / (1 - (1 - t) b) is right for both. It enters earlier where it slopes, as
 * far as the blur opens a seam, and is broad, or it would vanish at the
 * start of its own interval; what crosses the whole ramp between two pixels is a silhouette. Slope and
 * breadth are read where they count; 0 stands for no slope, and for broad. */
static inline float16 matting_rise(float16 w, const __global float *slope, const __global float *broad,
                                   PyramidRamps ramps)
{
    float16 rising = matting_axis(w) * ramps.ramp.x + ramps.ramp.y;
#if !PYRAMID_PAPER
    const float16 zero = (float16)(0.0f), one = (float16)(1.0f);
    float16 rest = w * ramps.before.x + ramps.before.y; /* 1 - t */
    rest = rising >= 1.0f && rest > 0.0f ? (rest > 1.0f ? one : rest) : zero;
    float16 between = rising > 0.0f && rising < 1.0f ? one : zero;
    if (sum16(between) > 0.0f) {
        float16 needed = slope ? load_quad(slope) : zero;
        needed = needed > -1.0f / ramps.ramp.x ? zero : needed * ramps.seam;
        needed = needed > 1.0f ? one : needed;
        needed = needed < 1e-3f ? (float16)(1e-3f) : needed;
        float16 early = clamp01((rising - 1.0f) / needed + 1.0f);
        if (broad && sum16(early * between) > 0.0f) early *= clamp01(24.0f * load_quad(broad) - 23.0f);
        rising = rising < 1.0f ? early : rising;
    }
    if (broad && sum16(rest) > 0.0f) {
        float16 others = 1.0f - rest * load_quad(broad);
        float16 own = others > 1e-3f ? (1.0f - rest) / others : one;
        rising = rest > 0.0f ? own : rising;
    }
#endif
    return w < 0.0f ? (float16)(0.0f) : clamp01(rising);
}

static inline float16 matting_fall(float16 w, float4 ramp) { return clamp01(matting_axis(w) * ramp.z + ramp.w); }

/* --- culling (section 3.1) --- */

/* Nearest and farthest slot of a block tell of most that a sub-image culls all of it, or none, or has no use for it. */
static inline const __global float *span_of(const __global float *span, PyramidSize size, int s, int x, int y)
{
    return span + (((size_t)s * size.height + y) * size.pitch + x) / 8;
}

/* The first source of which a sub-image does not cull all 16 slots; size.sources if there is none, or no such pixel. */
static inline int first_left(const __global float *span, PyramidSize size, PyramidRamps ramps, int x, int y)
{
    if (x < 0 || x >= size.pitch || y < 0 || y >= size.height) return size.sources;
#if PYRAMID_PAPER
    return 0;
#else
    int s = 0;
    for (; s < size.sources; s++) {
        const __global float *of = span_of(span, size, s, x, y);
        const float farthest = of[1] < 0.0f ? EMPTY - of[1] : of[1];
        if (of[0] >= 0.0f && farthest * ramps.ramp.x + ramps.ramp.y > 0.0f) break;
    }
    return s;
#endif
}

/* Whether a block has no holes and is too far behind a sub-image to be in it. */
static inline int is_behind(const __global float *of, PyramidRamps ramps)
{
    return of[1] >= 0.0f && of[0] * ramps.ramp.z + ramps.ramp.w <= 0.0f;
}

/* Whether a block has no holes and is past a sub-image's front ramp. */
static inline int is_past(const __global float *of, PyramidRamps ramps)
{
    return of[1] >= 0.0f && of[0] * ramps.ramp.x + ramps.ramp.y >= 1.0f;
}

/* The first source of 16 frame pixels, from source `first` on, that a sub-image does not cull.
 * Returns its front ramp, 0 where all sources are culled; there `from` is -1 and `inverse` EMPTY. `only` is the source
 * of all 16, -1 if all are culled, MIXED if they differ. */
#define MIXED (-2)
static inline float16 cull(float16 *from, int *only, float16 *inverse, const __global float *flat_inv,
                           const __global float *slope, const __global float *broad, const __global float *span,
                           PyramidSize size, PyramidRamps ramps, int x, int y, int first)
{
    float16 rise = (float16)(0.0f), w = (float16)(EMPTY), source = (float16)(-1.0f);
    float left = 16.0f;
    *only = -1;
    for (int s = first; s < size.sources; s++) {
        const size_t at = ((size_t)s * size.height + y) * size.pitch + x;
        float16 ws = load_quad(flat_inv + at);
#if PYRAMID_PAPER
        float16 r = matting_rise(ws, 0, 0, ramps);
#else
        const __global float *of = span_of(span, size, s, x, y);
        if (s == first && is_past(of, ramps) && (s > 0 || of[0] * ramps.before.x + ramps.before.y <= 0.0f)) {
            *only = s;
            *from = (float16)((float)s);
            *inverse = ws;
            return (float16)(1.0f);
        }
        float16 r = matting_rise(ws, slope + at, s == 0 ? broad + at : 0, ramps);
#endif
        int16 take = (rise <= 0.0f) & (r > 0.0f);
        w = take ? ws : w;
        source = take ? (float16)((float)s) : source;
        rise = take ? r : rise;
        const float before = left;
        left = count_holes(w);
        *only = left == 16.0f ? -1 : left == 0.0f && before == 16.0f ? s : MIXED;
        if (left == 0.0f) break;
    }
    *from = source;
    *inverse = w;
    return rise;
}

/* Colours of a quad from the sources that `cull` chose; 0 in holes. */
static inline float16 source_quad(const __global float *flat, PyramidSize size, float4 from, int only, int x, int y)
{
    float16 c = (float16)(0.0f);
    if (only == -1) return c;
    if (only >= 0) return load_quad(flat + (((size_t)only * size.height + y) * size.pitch + x) * 4);
    for (int s = 0; s < size.sources; s++) {
        float4 is = from == (float)s ? (float4)(1.0f) : (float4)(0.0f);
        if (sum4(is) == 0.0f) continue;
        c += load_quad(flat + (((size_t)s * size.height + y) * size.pitch + x) * 4) * spread(is);
    }
    return c;
}

/* --- disocclusion (section 3.2): pull-push --- */

/* One coarser quad from two rows of eight finer pixels: the mean of those of 2x2 that are no holes. Holes hold colour 0
 * and a negative inverse depth. */
static inline void pull_quad(__global float *color, __global float *inv, float16 top0, float16 top1, float8 w_top,
                             float16 low0, float16 low1, float8 w_low)
{
    float8 known_top = w_top < 0.0f ? (float8)(0.0f) : (float8)(1.0f);
    float8 known_low = w_low < 0.0f ? (float8)(0.0f) : (float8)(1.0f);
    float8 known = known_top + known_low, w = known_top * w_top + known_low * w_low;
    float16 a = top0 + low0, b = top1 + low1;
    float16 sum = (float16)(a.s0123 + a.s4567, a.s89ab + a.scdef, b.s0123 + b.s4567, b.s89ab + b.scdef);
    float4 count = known.s0246 + known.s1357, depth = w.s0246 + w.s1357;
    float4 scale = count > 0.0f ? 1.0f / count : (float4)(0.0f);
    store_quad(color, sum * spread(scale));
    store_four(inv, count > 0.0f ? depth * scale : (float4)(EMPTY));
}

/* pyramid_cull: culls a sub-image's foreground and pulls level 1 from what is left.
 * source  sections 3.1 and 3.2; Strengert et al. 2006
 * reads   flat, flat_inv, slope, broad, span  the stack of RGBZ images
 *         table  int4[sub-images][PYRAMID_LEVELS]; matting  PyramidMatting
 * writes  fill      float[][4]  level 1 of all sub-images, up to the pitch
 *         fill_inv  float[]
 * range   3-D: (items per row, sub-images, rows of level 1 of the largest sub-image), any local size */
__kernel void pyramid_cull(__global float *restrict fill, __global float *restrict fill_inv,
                           const __global float *restrict flat, const __global float *restrict flat_inv,
                           const __global float *restrict slope, const __global float *restrict broad,
                           const __global float *restrict span, const __global int4 *restrict table,
                           const __global PyramidMatting *restrict matting, PyramidSize size)
{
    const int i = get_global_id(1);
    const int4 sub = table[i * PYRAMID_LEVELS], level = table[i * PYRAMID_LEVELS + 1];
    const int row = (int)get_global_id(2) - (size.top - sub.x) / 2;
    if (row < 0 || row >= level.z) return;
    const PyramidRamps ramps = ramps_of(matting, i);
    const int y = 2 * row - sub.x;
    for (int b = get_global_id(0); b < level.w / 8; b += get_global_size(0)) {
        const int x = 16 * b - sub.x;
        const size_t to = (size_t)level.x + (size_t)row * level.w + 8 * b;
        float16 from[2], w[2];
        int only[2];
        for (int r = 0; r < 2; r++)
            cull(&from[r], &only[r], &w[r], flat_inv, slope, broad, span, size, ramps, x, y + r,
                 first_left(span, size, ramps, x, y + r));
        if (only[0] == -1 && only[1] == -1) {
            store_quad(fill + to * 4, (float16)(0.0f));
            store_quad(fill + to * 4 + 16, (float16)(0.0f));
            store_four(fill_inv + to, (float4)(EMPTY));
            store_four(fill_inv + to + 4, (float4)(EMPTY));
            continue;
        }
#pragma unroll
        for (int h = 0; h < 2; h++) { /* halves of the block */
            float16 c[2][2];
#pragma unroll
            for (int r = 0; r < 2; r++) {
                float8 f = h ? from[r].hi : from[r].lo;
                c[r][0] = source_quad(flat, size, f.lo, only[r], x + 8 * h, y + r);
                c[r][1] = source_quad(flat, size, f.hi, only[r], x + 8 * h + 4, y + r);
            }
            pull_quad(fill + (to + 4 * h) * 4, fill_inv + to + 4 * h, c[0][0], c[0][1], h ? w[0].hi : w[0].lo, c[1][0],
                      c[1][1], h ? w[1].hi : w[1].lo);
        }
    }
}

/* pyramid_pull: a coarser level of the pull phase.
 * source  Strengert et al. 2006; section 3.2
 * reads   table  int4[sub-images][PYRAMID_LEVELS]
 * updates fill, fill_inv  reads level k, writes level k + 1
 * range   3-D: (items per row, sub-images, rows of level k + 1), any local size */
__kernel void pyramid_pull(__global float *restrict fill, __global float *restrict fill_inv,
                           const __global int4 *restrict table, int k)
{
    const int i = get_global_id(1), row = get_global_id(2);
    const int4 fine = table[i * PYRAMID_LEVELS + k], coarse = table[i * PYRAMID_LEVELS + k + 1];
    if (row >= coarse.z) return;
    const int has_low = 2 * row + 1 < fine.z;
    for (int x = 4 * get_global_id(0); x < coarse.w; x += 4 * get_global_size(0)) {
        const size_t to = (size_t)coarse.x + (size_t)row * coarse.w + x;
        if (x >= coarse.y) { /* past the row */
            store_quad(fill + to * 4, (float16)(0.0f));
            store_four(fill_inv + to, (float4)(EMPTY));
            continue;
        }
        const size_t top = (size_t)fine.x + (size_t)(2 * row) * fine.w + 2 * x;
        const size_t low = top + (has_low ? fine.w : 0);
        const float keep = has_low ? 1.0f : 0.0f;
        float8 w_low = has_low ? load_eight(fill_inv + low) : (float8)(EMPTY);
        pull_quad(fill + to * 4, fill_inv + to, load_quad(fill + top * 4), load_quad(fill + top * 4 + 16),
                  load_eight(fill_inv + top), load_quad(fill + low * 4) * keep, load_quad(fill + low * 4 + 16) * keep,
                  w_low);
    }
}

/* Two rows of a coarser level that a finer row lies between, the nearer one first. */
typedef struct {
    size_t near, far; /* first pixel */
    int width;
} Between;

static inline Between between(int4 level, int fine_row)
{
    const int near = clamp_index(fine_row >> 1, level.z - 1);
    const int far = clamp_index(fine_row & 1 ? near + 1 : near - 1, level.z - 1);
    Between rows = {(size_t)level.x + (size_t)near * level.w, (size_t)level.x + (size_t)far * level.w, level.y};
    return rows;
}

/* Quad at x of a row; beyond its ends the row repeats its edge. */
static inline float16 load_quad_edge(const __global float *row, int x, int width)
{
    if (x >= 0 && x + 4 <= width) return load_quad(row + x * 4);
    const int last = width - 1;
    return (float16)(load_pixel(row + clamp_index(x, last) * 4), load_pixel(row + clamp_index(x + 1, last) * 4),
                     load_pixel(row + clamp_index(x + 2, last) * 4), load_pixel(row + clamp_index(x + 3, last) * 4));
}

static inline float8 load_eight_edge(const __global float *row, int x, int width)
{
    if (x >= 0 && x + 8 <= width) return load_eight(row + x);
    float v[8];
    for (int t = 0; t < 8; t++) v[t] = row[clamp_index(x + t, width - 1)];
    return (float8)(v[0], v[1], v[2], v[3], v[4], v[5], v[6], v[7]);
}

/* Quadratic B-spline subdivision: the eight finer pixels over the coarser quad at x (weights 9, 3, 3, 1 of 16). */
static inline void expand_quad(float16 fine[2], const __global float *image, Between rows, int x)
{
    const __global float *near = image + rows.near * 4, *far = image + rows.far * 4;
    float16 left = 0.75f * load_quad_edge(near, x - 1, rows.width) + 0.25f * load_quad_edge(far, x - 1, rows.width);
    float16 mid = 0.75f * load_quad_edge(near, x, rows.width) + 0.25f * load_quad_edge(far, x, rows.width);
    float16 right = 0.75f * load_quad_edge(near, x + 1, rows.width) + 0.25f * load_quad_edge(far, x + 1, rows.width);
    float16 even = 0.75f * mid + 0.25f * left, odd = 0.75f * mid + 0.25f * right;
    fine[0] = (float16)(even.s0123, odd.s0123, even.s4567, odd.s4567);
    fine[1] = (float16)(even.s89ab, odd.s89ab, even.scdef, odd.scdef);
}

/* The same for inverse depth: 16 finer pixels over eight coarser ones. */
static inline float16 expand_depth(const __global float *inv, Between rows, int x)
{
    const __global float *near = inv + rows.near, *far = inv + rows.far;
    float8 left = 0.75f * load_eight_edge(near, x - 1, rows.width) + 0.25f * load_eight_edge(far, x - 1, rows.width);
    float8 mid = 0.75f * load_eight_edge(near, x, rows.width) + 0.25f * load_eight_edge(far, x, rows.width);
    float8 right = 0.75f * load_eight_edge(near, x + 1, rows.width) + 0.25f * load_eight_edge(far, x + 1, rows.width);
    float8 e = 0.75f * mid + 0.25f * left, o = 0.75f * mid + 0.25f * right;
    return (float16)(e.s0, o.s0, e.s1, o.s1, e.s2, o.s2, e.s3, o.s3, e.s4, o.s4, e.s5, o.s5, e.s6, o.s6, e.s7, o.s7);
}

/* pyramid_push: fills the holes of a level from the next coarser one, which has none unless all is a hole.
 * source  Strengert et al. 2006; section 3.2
 * reads   table  int4[sub-images][PYRAMID_LEVELS]
 * updates fill, fill_inv  reads level k + 1, writes holes of level k
 * range   3-D: (items per row, sub-images, rows of level k), any local size */
__kernel void pyramid_push(__global float *restrict fill, __global float *restrict fill_inv,
                           const __global int4 *restrict table, int k)
{
    const int i = get_global_id(1), row = get_global_id(2);
    const int4 fine = table[i * PYRAMID_LEVELS + k], coarse = table[i * PYRAMID_LEVELS + k + 1];
    if (row >= fine.z || coarse.y == 0) return;
    const Between rows = between(coarse, row);
    for (int x = 16 * get_global_id(0); x < fine.y; x += 16 * get_global_size(0)) {
        const size_t to = (size_t)fine.x + (size_t)row * fine.w + x;
        float16 w = load_quad(fill_inv + to);
        if (count_holes(w) == 0.0f) continue;
        float16 filled = expand_depth(fill_inv, rows, x / 2);
        store_quad(fill_inv + to, w < 0.0f ? filled : w);
#pragma unroll
        for (int h = 0; h < 2; h++) {
            float8 w8 = h ? w.hi : w.lo;
            if (sum4(w8.lo < 0.0f ? (float4)(1.0f) : (float4)(0.0f)) +
                    sum4(w8.hi < 0.0f ? (float4)(1.0f) : (float4)(0.0f)) == 0.0f) continue;
            float16 c[2];
            expand_quad(c, fill, rows, x / 2 + 4 * h);
            __global float *at = fill + (to + 8 * h) * 4;
            store_quad(at, spread(w8.lo) < 0.0f ? c[0] : load_quad(at));
            store_quad(at + 16, spread(w8.hi) < 0.0f ? c[1] : load_quad(at + 16));
        }
    }
}

/* 16 pixels of a sub-image's level 0: culled, disoccluded and weighted. Returns 0 if nothing is there. */
static inline int matted_block(float16 quad[4], const __global float *flat, const __global float *flat_inv,
                               const __global float *slope, const __global float *broad, const __global float *span,
                               const __global float *fill, const __global float *fill_inv, int4 sub, int4 level,
                               PyramidSize size, PyramidRamps ramps, int x, int y)
{
    const int first = first_left(span, size, ramps, x, y);
#if !PYRAMID_PAPER
    if (first < size.sources && is_behind(span_of(span, size, first, x, y), ramps)) {
#pragma unroll
        for (int q = 0; q < 4; q++) quad[q] = (float16)(0.0f);
        return 0;
    }
#endif
    float16 from, w;
    int only;
    float16 weight = cull(&from, &only, &w, flat_inv, slope, broad, span, size, ramps, x, y, first);
    /* What a visible surface with a share of its weight lets through of the next that is not culled. */
    float16 lets = from == 0.0f ? 1.0f - weight : (float16)(0.0f);
    weight *= matting_fall(w, ramps.ramp);
    float16 filled = (float16)(0.0f); /* weight of holes */
    float holes = 0.0f;
    const Between rows = between(level, y + sub.x);
    if (only < 0) {
        float16 v = expand_depth(fill_inv, rows, (x + sub.x) / 2);
        filled = matting_rise(v, 0, 0, ramps) * matting_fall(v, ramps.ramp);
        filled = w < 0.0f ? filled : (float16)(0.0f);
        holes = sum16(filled);
    }
    const float pixels = sum16(weight);
#pragma unroll
    for (int q = 0; q < 4; q++) quad[q] = (float16)(0.0f);
    if (pixels + holes + sum16(lets) <= 0.0f) return 0;
    if (pixels > 0.0f) {
#pragma unroll
        for (int q = 0; q < 4; q++)
            quad[q] = source_quad(flat, size, part(from, q), only, x + 4 * q, y) * spread(part(weight, q));
    }
#if !PYRAMID_PAPER
    if (sum16(lets) > 0.0f) {
        for (int s = 1; s < size.sources; s++) {
            const size_t at = ((size_t)s * size.height + y) * size.pitch + x;
            float16 ws = load_quad(flat_inv + at);
            float16 r = lets * matting_rise(ws, slope + at, 0, ramps);
            lets = r > 0.0f ? (float16)(0.0f) : lets;
            r *= matting_fall(ws, ramps.ramp);
            if (sum16(r) == 0.0f) continue;
#pragma unroll
            for (int q = 0; q < 4; q++) quad[q] += load_quad(flat + (at + 4 * q) * 4) * spread(part(r, q));
        }
    }
#endif
    if (holes > 0.0f) {
#pragma unroll
        for (int h = 0; h < 2; h++) {
            float16 c[2];
            expand_quad(c, fill, rows, (x + sub.x) / 2 + 4 * h);
            quad[2 * h] += c[0] * spread(part(filled, 2 * h));
            quad[2 * h + 1] += c[1] * spread(part(filled, 2 * h + 1));
        }
    }
    return 1;
}

/* --- blurring (section 3.4): 4x4 box analysis, quadratic B-spline synthesis --- */

/* Four coarser pixels from twelve finer ones on, of which ten count: sums of four, two apart. */
static inline float16 box_quad(float16 a, float16 b, float16 c)
{
    float4 s1 = a.s0123 + a.s4567, s2 = a.s89ab + a.scdef, s3 = b.s0123 + b.s4567, s4 = b.s89ab + b.scdef;
    float4 s5 = c.s0123 + c.s4567;
    return (float16)(s1, s2, s3, s4) + (float16)(s2, s3, s4, s5);
}

/* pyramid_matte: level 0 of a sub-image, matted, and reduced to level 1 in the same breath.
 * source  sections 3.3 and 3.4
 * reads   flat, flat_inv, slope, broad, span  the stack of RGBZ images
 *         fill, fill_inv  level 1 without holes
 *         table  int4[sub-images][PYRAMID_LEVELS]; matting  PyramidMatting
 * writes  blur  float[][4]  level 1 of all sub-images that have steps
 * range   3-D groups: (segments of a row, sub-images, blocks of PYRAMID_ROWS rows of level 1); local size (any, 1, 1)
 * local   lines  float[2][2 * segment + 32][4]  sums of two rows of level 0, from 16 px before the segment on */
__kernel void pyramid_matte(__global float *restrict blur, const __global float *restrict flat,
                            const __global float *restrict flat_inv, const __global float *restrict slope,
                            const __global float *restrict broad, const __global float *restrict span,
                            const __global float *restrict fill,
                            const __global float *restrict fill_inv, const __global int4 *restrict table,
                            const __global PyramidMatting *restrict matting, PyramidSize size, int segment,
                            __local float *restrict lines)
{
    const int lid = get_local_id(0), items = get_local_size(0);
    const int i = get_group_id(1);
    const int4 sub = table[i * PYRAMID_LEVELS], level = table[i * PYRAMID_LEVELS + 1];
    const PyramidRamps ramps = ramps_of(matting, i);
    const int line_width = 2 * segment + 32;
    const int x0 = (int)get_group_id(0) * segment;
    const int first = 2 * x0 - 16; /* level 0 pixel at the start of a line */
    const int y0 = (int)get_group_id(2) * PYRAMID_ROWS - (size.top - sub.x) / 2;
    const int height = sub.y > 0 ? level.z : -1; /* no rows for a sub-image that is not blurred */

    for (int p = 0; p <= PYRAMID_ROWS; p++) {
        const int row = y0 + p;
        __local float *line = lines + (p & 1) * line_width * 4;
        const __local float *other = lines + (~p & 1) * line_width * 4;
        if (row >= 0 && row <= height && x0 < level.y) {
            for (int b = lid; b < line_width / 16; b += items) {
                const int x = first + 16 * b;
                if (x < 0 || x >= sub.z) continue;
                float16 sum[4], quad[4];
                matted_block(sum, flat, flat_inv, slope, broad, span, fill, fill_inv, sub, level, size, ramps,
                             x - sub.x, clamp_index(2 * row - 1, sub.w - 1) - sub.x);
                matted_block(quad, flat, flat_inv, slope, broad, span, fill, fill_inv, sub, level, size, ramps,
                             x - sub.x, clamp_index(2 * row, sub.w - 1) - sub.x);
#pragma unroll
                for (int q = 0; q < 4; q++) store_quad_local(line + (16 * b + 4 * q) * 4, sum[q] + quad[q]);
            }
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        if (p > 0 && row >= 1 && row <= height) { /* row - 1 has both its pairs of rows now */
            const int end = x0 + segment < level.y ? x0 + segment : level.y;
            for (int x = x0 + 4 * lid; x < end; x += 4 * items) {
                const int at = 2 * x - 1 - first;
                float16 v[3];
                if (x > 0 && 2 * x + 8 < sub.z) {
#pragma unroll
                    for (int t = 0; t < 3; t++)
                        v[t] = load_quad_local(line + (at + 4 * t) * 4) + load_quad_local(other + (at + 4 * t) * 4);
                } else {
                    for (int t = 0; t < 3; t++) {
                        float4 pixel[4];
                        for (int j = 0; j < 4; j++) {
                            int from = (clamp_index(2 * x - 1 + 4 * t + j, sub.z - 1) - first) * 4;
                            const __local float *u = line + from, *d = other + from;
                            pixel[j] = (float4)(u[0] + d[0], u[1] + d[1], u[2] + d[2], u[3] + d[3]);
                        }
                        v[t] = (float16)(pixel[0], pixel[1], pixel[2], pixel[3]);
                    }
                }
                store_quad(blur + ((size_t)level.x + (size_t)(row - 1) * level.w + x) * 4,
                           0.0625f * box_quad(v[0], v[1], v[2]));
            }
        }
        barrier(CLK_LOCAL_MEM_FENCE);
    }
}

/* pyramid_reduce: the next coarser level by a 4x4 box.
 * source  section 3.4; Kraus & Strengert 2007, "Pyramid Filters Based on Bilinear Interpolation"
 * reads   table  int4[sub-images][PYRAMID_LEVELS]
 * updates blur  reads level k, writes level k + 1 of sub-images with more than k steps
 * range   3-D: (items per row, sub-images, rows of level k + 1), any local size */
__kernel void pyramid_reduce(__global float *restrict blur, const __global int4 *restrict table, int k)
{
    const int i = get_global_id(1), row = get_global_id(2);
    const int4 fine = table[i * PYRAMID_LEVELS + k], coarse = table[i * PYRAMID_LEVELS + k + 1];
    if (table[i * PYRAMID_LEVELS].y <= k || row >= coarse.z) return;
    for (int x = 4 * get_global_id(0); x < coarse.y; x += 4 * get_global_size(0)) {
        float16 v[3] = {(float16)(0.0f), (float16)(0.0f), (float16)(0.0f)};
        for (int j = 0; j < 4; j++) {
            const __global float *from =
                blur + ((size_t)fine.x + (size_t)clamp_index(2 * row - 1 + j, fine.z - 1) * fine.w) * 4;
#pragma unroll
            for (int t = 0; t < 3; t++) v[t] += load_quad_edge(from, 2 * x - 1 + 4 * t, fine.y);
        }
        store_quad(blur + ((size_t)coarse.x + (size_t)row * coarse.w + x) * 4, 0.0625f * box_quad(v[0], v[1], v[2]));
    }
}

/* pyramid_expand: the next finer level by quadratic B-spline subdivision.
 * source  section 3.4; Strengert et al. 2006
 * reads   table  int4[sub-images][PYRAMID_LEVELS]
 * updates blur  reads level k + 1, writes level k of sub-images with more than k steps
 * range   3-D: (items per row, sub-images, rows of level k), any local size */
__kernel void pyramid_expand(__global float *restrict blur, const __global int4 *restrict table, int k)
{
    const int i = get_global_id(1), row = get_global_id(2);
    const int4 fine = table[i * PYRAMID_LEVELS + k], coarse = table[i * PYRAMID_LEVELS + k + 1];
    if (table[i * PYRAMID_LEVELS].y <= k || row >= fine.z) return;
    const Between rows = between(coarse, row);
    __global float *to = blur + ((size_t)fine.x + (size_t)row * fine.w) * 4;
    for (int x = 4 * get_global_id(0); 2 * x < fine.y; x += 4 * get_global_size(0)) {
        float16 quad[2];
        expand_quad(quad, blur, rows, x);
        store_quad(to + 8 * x, quad[0]);
        store_quad(to + 8 * x + 16, quad[1]);
    }
}

/* --- blending (section 3.5) --- */

/* Divide four pixels by coverage and store them at the place the guard band leaves. */
static inline void store_finished(__global float *out, float16 v, PyramidSize size, int x, int y)
{
    const int ox = x - size.guard, oy = y - size.guard;
    const int width = size.width - 2 * size.guard, height = size.height - 2 * size.guard;
    if (oy < 0 || oy >= height || ox <= -4 || ox >= width) return;
    __global float *to = out + ((long)oy * width + ox) * 4;
#if PYRAMID_DIVIDE
    float4 coverage = v.s37bf;
    float4 scale = coverage > PYRAMID_MIN_COVERAGE ? 1.0f / coverage : (float4)(0.0f);
    v = v * spread(scale);
    v.s37bf = scale > 0.0f ? (float4)(1.0f) : (float4)(0.0f);
#endif
#if PYRAMID_ALPHA == 1
    float alpha[4] = {v.s0, v.s4, v.s8, v.sc};
    for (int i = 0; i < 4; i++)
        if (ox + i >= 0 && ox + i < width) to[4 * i + 3] = alpha[i] > 1.0f ? 1.0f : alpha[i];
#else
    if (ox >= 0 && ox + 4 <= width) {
        store_quad(to, v);
    } else {
        float4 pixel[4] = {v.s0123, v.s4567, v.s89ab, v.scdef};
        for (int i = 0; i < 4; i++)
            if (ox + i >= 0 && ox + i < width) store_pixel(to + 4 * i, pixel[i]);
    }
#endif
}

/* pyramid_blend: expands level 1 of every sub-image and lays one over the other, nearest first (eqs. 14-15); crops the
 * guard band.
 * reads   blur  level 1 of sub-images with steps
 *         flat, flat_inv, slope, broad, span, fill, fill_inv  for the one in focus, which is not blurred
 *         table  int4[sub-images][PYRAMID_LEVELS]; matting  PyramidMatting
 * writes  out  float[height - 2*guard][width - 2*guard][4]
 * range   2-D: (items per row, height - 2*guard), any local size; an item takes every get_global_size(0)-th block */
__kernel void pyramid_blend(__global float *restrict out, const __global float *restrict blur,
                            const __global float *restrict flat, const __global float *restrict flat_inv,
                            const __global float *restrict slope, const __global float *restrict broad,
                            const __global float *restrict span, const __global float *restrict fill,
                            const __global float *restrict fill_inv,
                            const __global int4 *restrict table,
                            const __global PyramidMatting *restrict matting, PyramidSize size, int count)
{
    const int y = size.guard + (int)get_global_id(1);
    for (int x = size.guard / 16 * 16 + 16 * (int)get_global_id(0); x < size.width - size.guard;
         x += 16 * (int)get_global_size(0)) {
        float16 sum[4] = {(float16)(0.0f), (float16)(0.0f), (float16)(0.0f), (float16)(0.0f)};
        for (int i = 0; i < count; i++) {
            const int4 sub = table[i * PYRAMID_LEVELS], level = table[i * PYRAMID_LEVELS + 1];
            float16 quad[4];
            if (sub.y == 0) {
                if (!matted_block(quad, flat, flat_inv, slope, broad, span, fill, fill_inv, sub, level, size,
                                  ramps_of(matting, i), x, y)) continue;
            } else {
                const Between rows = between(level, y + sub.x);
                expand_quad(quad, blur, rows, (x + sub.x) / 2);
                expand_quad(quad + 2, blur, rows, (x + sub.x) / 2 + 4);
            }
            int covered = 1;
#pragma unroll
            for (int q = 0; q < 4; q++) {
                sum[q] += (1.0f - sum[q].s33337777bbbbffff) * quad[q];
                covered &= sum[q].s3 >= 1.0f && sum[q].s7 >= 1.0f && sum[q].sb >= 1.0f && sum[q].sf >= 1.0f;
            }
            if (covered) break;
        }
#pragma unroll
        for (int q = 0; q < 4; q++)
            if (x + 4 * q < size.width) store_finished(out, sum[q], size, x + 4 * q, y);
    }
}
