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
 * run of its row. Rows are numbered so that the same one shows the same part of the frame in all sub-images, which
 * follow each other closely and find it in the cache. */

#include "slots.clh"

/* PoCL's compiler leaves calls of large functions, whose structs then go through memory: up to half of a kernel's time. */
#define INLINE static inline __attribute__((always_inline))

#define PYRAMID_LEVELS 16
/* The most sub-images. */
#define PYRAMID_COUNT 24
/* Rows of level 1 that a work-group of pyramid_matte makes. */
#define PYRAMID_ROWS 8
/* Pixels of a row whose depths are told together; sub-images begin at multiples of it. */
#define PYRAMID_BLOCK 16
/* Pixels that an item takes at a time, of one block: all of it where items are few, or LANES. */
#ifndef PYRAMID_RUN
#define PYRAMID_RUN PYRAMID_BLOCK
#endif
#define PYRAMID_RUNS (PYRAMID_RUN / LANES)
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

INLINE PyramidRamps ramps_of(const __global PyramidMatting *matting, int i)
{
    PyramidRamps ramps = {matting->ramp[i], matting->before[i], matting->seam[i]};
    return ramps;
}

/* A floath holds LANES / 2 values, one for each of 2 * PIXELS pixels. */
#if LANES == 16
typedef float8 floath;
#elif LANES == 8
typedef float4 floath;
#else
typedef float2 floath;
#endif

typedef floath __attribute__((aligned(4))) floath_unaligned;
typedef floatp __attribute__((aligned(4))) floatp_unaligned;

INLINE floath load_half(const __global float *p) { return *(const __global floath_unaligned *)p; }
INLINE void store_half(__global float *p, floath v) { *(__global floath_unaligned *)p = v; }
INLINE void store_part(__global float *p, floatp v) { *(__global floatp_unaligned *)p = v; }

/* The least of PIXELS values. */
INLINE float least_part(floatp v)
{
#if LANES == 16
    const float2 two = v.lo < v.hi ? v.lo : v.hi;
    return two.x < two.y ? two.x : two.y;
#elif LANES == 8
    return v.x < v.y ? v.x : v.y;
#else
    return v;
#endif
}

/* Of 2 * PIXELS pixels those with even places, or with odd ones; and one of the former beside one of the latter. */
INLINE floatn even_pixels(floatn a, floatn b)
{
#if LANES == 16
    return (floatn)(a.s0123, a.s89ab, b.s0123, b.s89ab);
#elif LANES == 8
    return (floatn)(a.lo, b.lo);
#else
    return a;
#endif
}

INLINE floatn odd_pixels(floatn a, floatn b)
{
#if LANES == 16
    return (floatn)(a.s4567, a.scdef, b.s4567, b.scdef);
#elif LANES == 8
    return (floatn)(a.hi, b.hi);
#else
    return b;
#endif
}

INLINE void interleave_pixels(floatn to[2], floatn even, floatn odd)
{
#if LANES == 16
    to[0] = (floatn)(even.s0123, odd.s0123, even.s4567, odd.s4567);
    to[1] = (floatn)(even.s89ab, odd.s89ab, even.scdef, odd.scdef);
#elif LANES == 8
    to[0] = (floatn)(even.lo, odd.lo);
    to[1] = (floatn)(even.hi, odd.hi);
#else
    to[0] = even;
    to[1] = odd;
#endif
}

/* pyramid_flatten: what is seen from each source on, as an opaque RGBZ image.
 * reads   color      float[peels][height][width][4]
 *         inv_depth  float[peels][height][pitch]  1/m
 * writes  flat       float[sources][height][pitch][4]  0 in holes and past the row
 *         flat_inv   float[sources][height][pitch]     1/m, of the peel with which half of the pixel is covered
 * range   2-D: (items per row, sources * height), any local size; an item takes every get_global_size(0)-th LANES
 *         pixels */
__kernel void pyramid_flatten(__global float *restrict flat, __global float *restrict flat_inv,
                              const __global float *restrict color, const __global float *restrict inv_depth,
                              PyramidSize size)
{
    const int row = get_global_id(1);
    const int source = row / size.height, y = row % size.height;
    for (int x = LANES * get_global_id(0); x < size.pitch; x += LANES * get_global_size(0)) {
        floatn image[4] = {(floatn)(0.0f), (floatn)(0.0f), (floatn)(0.0f), (floatn)(0.0f)};
        floatn depth = (floatn)(EMPTY), nearest = (floatn)(EMPTY), alpha = (floatn)(0.0f);
        for (int m = source; m < size.peels; m++) {
            const size_t at = (size_t)m * size.height + y;
            const floatn w = load_lanes(inv_depth + at * size.pitch + x);
            if (!any_lane(w >= 0.0f)) continue;
            floatn c[4];
#pragma unroll
            for (int q = 0; q < 4; q++) {
                const int n = size.width - x - PIXELS * q;
                c[q] = (floatn)(0.0f);
                if (n > 0) c[q] = load_pixels(color + (at * size.width + x + PIXELS * q) * 4, n);
                image[q] = over(image[q], c[q]);
            }
            const intn there = w >= 0.0f && CHANNEL_OF(c, ALPHA) > 0.0f;
            alpha = CHANNEL_OF(image, ALPHA);
            nearest = nearest < 0.0f && there ? w : nearest;
            depth = depth < 0.0f && there && alpha >= 0.5f ? w : depth;
            if (least_lane(alpha) >= 1.0f) break;
        }
        const intn inside = LANE_INDEX < size.width - x;
#if PYRAMID_VOID
        depth = depth < 0.0f ? nearest : depth;
        depth = depth < 0.0f ? (floatn)(0.0f) : depth;
        depth = inside ? depth : (floatn)(EMPTY);
        const floatn known = inside ? (floatn)(1.0f) : (floatn)(0.0f), scale = known;
#else
        const intn is_known = alpha >= 0.5f && inside;
        const floatn known = is_known ? (floatn)(1.0f) : (floatn)(0.0f);
        depth = is_known ? depth : (floatn)(EMPTY);
        floatn scale = (floatn)(0.0f);
        if (any_lane(is_known)) scale = is_known ? 1.0f / alpha : scale;
#endif
        const size_t to = (size_t)row * size.pitch + x;
        store_lanes(flat_inv + to, depth);
        const floatp coverage[4] = FOUR_PARTS(known);
#pragma unroll
        for (int q = 0; q < 4; q++) {
            floatn c = image[q] * spread_part(scale, q);
#if PYRAMID_ALPHA == 0
            c.ALPHA = coverage[q];
#elif PYRAMID_ALPHA == 1
            c = c.ALPHAS * every_pixel((float4)(1.0f, 0.0f, 0.0f, 0.0f));
            c.ALPHA = coverage[q];
#endif
            store_lanes(flat + (to + PIXELS * q) * 4, c);
        }
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
 *         span      float4[sources][height][pitch / PYRAMID_BLOCK]  of each block the nearest slot, EMPTY if all are
 *                   holes, and the farthest, or EMPTY minus it if there are holes, 1/m; the greatest slope; the least
 *                   of `broad`
 * range   2-D: (items per row, sources * height), any local size; an item takes every get_global_size(0)-th block */
__kernel void pyramid_slope(__global float *restrict slope, __global float *restrict broad,
                            __global float4 *restrict span, const __global float *restrict flat_inv,
                            const __global PyramidMatting *restrict matting, PyramidSize size, int count)
{
    const int row = get_global_id(1), y = row % size.height;
    const int width = size.width, height = size.height, pitch = size.pitch;
    for (int x0 = PYRAMID_BLOCK * get_global_id(0); x0 < pitch; x0 += PYRAMID_BLOCK * get_global_size(0)) {
        floatn nearest = (floatn)(EMPTY), farthest = (floatn)(MAXFLOAT), steepest = (floatn)(0.0f);
        floatn narrowest = (floatn)(1.0f);
        intn holes = (intn)(0);
#pragma unroll 1
        for (int x = x0; x < x0 + PYRAMID_BLOCK; x += LANES) {
            const size_t at = (size_t)row * pitch + x;
            const floatn w = load_lanes(flat_inv + at), step = slope_of(flat_inv + at, w, x, y, height, pitch, MAXFLOAT);
            store_lanes(slope + at, step);
            nearest = greater(nearest, w);
            farthest = w < 0.0f ? farthest : lesser(farthest, w);
            steepest = w < 0.0f ? steepest : greater(steepest, step);
            holes |= w < 0.0f;
            if (row >= height) continue;
            floatn share = (floatn)(1.0f);
            for (int i = 0; i < count; i++) {
                const float2 before = matting->before[i];
                if (before.x == 0.0f) continue;
                floatn rest = w * before.x + before.y;
                intn is_own = (rest > 0.0f) & (rest <= 1.0f) & (w >= 0.0f);
                if (!any_lane(is_own)) continue;
                const int around = matting->around[i];
                floatn near = breadth_of(flat_inv, w, x, y, width, height, pitch, around, before.x);
                floatn far = breadth_of(flat_inv, w, x, y, width, height, pitch, 2 * around, before.x);
                near = 1.0f - PYRAMID_NEAR_RING * (1.0f - near) - PYRAMID_FAR_RING * (1.0f - far);
                share = is_own ? near : share;
            }
            store_lanes(broad + at, share);
            narrowest = lesser(narrowest, share);
        }
        const float last = least_lane(farthest);
        span[((size_t)row * pitch + x0) / PYRAMID_BLOCK] =
            (float4)(greatest_lane(nearest), any_lane(holes) ? EMPTY - last : last, greatest_lane(steepest),
                     least_lane(narrowest));
    }
}

/* --- matting (section 3.3) --- */

INLINE floatn matting_axis(floatn w)
{
#if PYRAMID_PAPER
    return 1.0f / (w > 1e-20f ? w : (floatn)(1e-20f));
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
INLINE floatn matting_rise(floatn w, const __global float *slope, const __global float *broad,
                                  PyramidRamps ramps)
{
    floatn rising = matting_axis(w) * ramps.ramp.x + ramps.ramp.y;
#if !PYRAMID_PAPER
    const floatn zero = (floatn)(0.0f), one = (floatn)(1.0f);
    floatn rest = w * ramps.before.x + ramps.before.y; /* 1 - t */
    rest = rising >= 1.0f && rest > 0.0f ? (rest > 1.0f ? one : rest) : zero;
    const intn between = rising > 0.0f && rising < 1.0f;
    if (any_lane(between)) {
        floatn needed = slope ? load_lanes(slope) : zero;
        needed = needed > -1.0f / ramps.ramp.x ? zero : needed * ramps.seam;
        needed = needed > 1.0f ? one : needed;
        needed = needed < 1e-3f ? (floatn)(1e-3f) : needed;
        floatn early = clamp01((rising - 1.0f) / needed + 1.0f);
        if (broad && any_lane(between && early > 0.0f)) early *= clamp01(24.0f * load_lanes(broad) - 23.0f);
        rising = rising < 1.0f ? early : rising;
    }
    if (broad && any_lane(rest > 0.0f)) {
        floatn others = 1.0f - rest * load_lanes(broad);
        floatn own = others > 1e-3f ? (1.0f - rest) / others : one;
        rising = rest > 0.0f ? own : rising;
    }
#endif
    return w < 0.0f ? (floatn)(0.0f) : clamp01(rising);
}

INLINE floatn matting_fall(floatn w, float4 ramp) { return clamp01(matting_axis(w) * ramp.z + ramp.w); }

/* --- culling (section 3.1) --- */

/* What is known of a block in a sub-image. */
typedef struct {
    int first; /* the first source of which the sub-image does not cull all slots; size.sources if there is none */
    int kind;
} PyramidBlock;

#define BLOCK_MIXED 0
/* All of `first` is past the front ramp, without holes: no pixel is culled or shows what is behind it. */
#define BLOCK_PAST 1
/* The same, and all of it is too far behind the sub-image to be in it. */
#define BLOCK_BEHIND 2

/* The block of frame pixel (x, y), which may lie outside. What `span` holds tells of most that none of it counts, or all. */
INLINE PyramidBlock block_of(const __global float4 *span, PyramidSize size, PyramidRamps ramps, int x, int y)
{
    PyramidBlock block = {size.sources, BLOCK_MIXED};
    if (x < 0 || x >= size.pitch || y < 0 || y >= size.height) return block;
#if PYRAMID_PAPER
    block.first = 0;
#else
    span += ((size_t)y * size.pitch + x) / PYRAMID_BLOCK;
    for (int s = 0; s < size.sources; s++, span += (size_t)size.height * size.pitch / PYRAMID_BLOCK) {
        const float4 of = *span;
        const int has_holes = of.y < 0.0f;
        const float nearest = of.x, farthest = has_holes ? EMPTY - of.y : of.y;
        /* How much of the front ramp the steepest surface needs, and a rounding. */
        const float early = of.z > -1.0f / ramps.ramp.x ? 1.0f : clamp(1.0001f * of.z * ramps.seam, 1.0001e-3f, 1.0f);
        if (nearest < 0.0f || farthest * ramps.ramp.x + ramps.ramp.y <= 1.0f - early) continue;
        block.first = s;
        if (has_holes) break;
        if (nearest * ramps.ramp.z + ramps.ramp.w <= 0.0f) block.kind = BLOCK_BEHIND;
        else if (nearest * ramps.ramp.x + ramps.ramp.y >= 1.0f &&
                 (s > 0 || nearest * ramps.before.x + ramps.before.y <= 0.0f || of.w >= 1.0f)) block.kind = BLOCK_PAST;
        break;
    }
#endif
    return block;
}

/* Front ramp of LANES slots of source s, of which `at` is the first. */
INLINE floatn rise_of(floatn w, int s, size_t at, const __global float *slope, const __global float *broad,
                      PyramidRamps ramps)
{
#if PYRAMID_PAPER
    return matting_rise(w, 0, 0, ramps);
#else
    return matting_rise(w, slope + at, s == 0 ? broad + at : 0, ramps);
#endif
}

/* Adds LANES frame pixels to `color`, `count` and `depth`, each from the first source that a sub-image does not cull;
 * nothing where it culls all. */
INLINE void add_culled(floatn color[4], floatn *count, floatn *depth, const __global float *flat,
                       const __global float *flat_inv, const __global float *slope, const __global float *broad,
                       PyramidSize size, PyramidRamps ramps, int x, int y, PyramidBlock block)
{
    intn open = (intn)(-1);
    for (int s = block.first; s < size.sources; s++) {
        const size_t at = ((size_t)s * size.height + y) * size.pitch + x;
        const floatn w = load_lanes(flat_inv + at);
        intn take = open;
        if (block.kind == BLOCK_MIXED) take = open && rise_of(w, s, at, slope, broad, ramps) > 0.0f;
        if (!any_lane(take)) continue;
        const floatn one = take ? (floatn)(1.0f) : (floatn)(0.0f);
#pragma unroll
        for (int q = 0; q < 4; q++) color[q] += load_lanes(flat + (at + PIXELS * q) * 4) * spread_part(one, q);
        *count += one;
        *depth += w * one;
        open = open && !take;
        if (!any_lane(open)) break;
    }
}

/* --- disocclusion (section 3.2): pull-push --- */

/* PIXELS coarser pixels from twice as many finer ones, two rows of which are summed up: the mean of those of 2x2 that
 * are no holes, which `count` tells. Holes hold colour 0 and a negative inverse depth. */
INLINE void pull_pixels(__global float *color, __global float *inv, floatn left, floatn right, floath count,
                        floath depth)
{
    const floatp known = count.even + count.odd;
    const floatp scale = known > 0.0f ? 1.0f / known : (floatp)(0.0f);
    store_lanes(color, (even_pixels(left, right) + odd_pixels(left, right)) * spread(scale));
    store_part(inv, known > 0.0f ? (depth.even + depth.odd) * scale : (floatp)(EMPTY));
}

/* The same for 2 * PIXELS coarser pixels where there are no holes. */
INLINE void pull_whole(__global float *color, __global float *inv, const __global float *flat,
                       const __global float *flat_inv, size_t top, size_t low)
{
#pragma unroll
    for (int h = 0; h < 2; h++) {
        const __global float *upper = flat + (top + 2 * PIXELS * h) * 4, *lower = flat + (low + 2 * PIXELS * h) * 4;
        const floatn a = load_lanes(upper) + load_lanes(lower), b = load_lanes(upper + LANES) + load_lanes(lower + LANES);
        store_lanes(color + LANES * h, 0.25f * (even_pixels(a, b) + odd_pixels(a, b)));
    }
    const floatn w = load_lanes(flat_inv + top) + load_lanes(flat_inv + low);
    store_half(inv, 0.25f * (w.even + w.odd));
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
                           const __global float4 *restrict span, const __global int4 *restrict table,
                           const __global PyramidMatting *restrict matting, PyramidSize size)
{
    const int i = get_global_id(1);
    const int4 sub = table[i * PYRAMID_LEVELS], level = table[i * PYRAMID_LEVELS + 1];
    const int row = (int)get_global_id(2) - (size.top - sub.x) / 2;
    if (row < 0 || row >= level.z) return;
    const PyramidRamps ramps = ramps_of(matting, i);
    const int y = 2 * row - sub.x;
    for (int first = PYRAMID_RUN * get_global_id(0); first < 2 * level.w; first += PYRAMID_RUN * get_global_size(0)) {
        const int x0 = first - sub.x;
        const size_t to0 = (size_t)level.x + (size_t)row * level.w + first / 2;
        const PyramidBlock upper = block_of(span, size, ramps, x0, y), lower = block_of(span, size, ramps, x0, y + 1);
        if (upper.first == size.sources && lower.first == size.sources) {
#pragma unroll
            for (int j = 0; j < PYRAMID_RUNS; j++) {
                const size_t to = to0 + 2 * PIXELS * j;
                store_lanes(fill + to * 4, (floatn)(0.0f));
                store_lanes(fill + to * 4 + LANES, (floatn)(0.0f));
                store_half(fill_inv + to, (floath)(EMPTY));
            }
            continue;
        }
        if (upper.kind != BLOCK_MIXED && lower.kind != BLOCK_MIXED) {
            const size_t top = ((size_t)upper.first * size.height + y) * size.pitch + x0;
            const size_t low = ((size_t)lower.first * size.height + y + 1) * size.pitch + x0;
#pragma unroll
            for (int j = 0; j < PYRAMID_RUNS; j++) {
                const size_t to = to0 + 2 * PIXELS * j;
                pull_whole(fill + to * 4, fill_inv + to, flat, flat_inv, top + LANES * j, low + LANES * j);
            }
            continue;
        }
        for (int j = 0; j < PYRAMID_RUNS; j++) {
            const int x = x0 + LANES * j;
            const size_t to = to0 + 2 * PIXELS * j;
            floatn color[4] = {(floatn)(0.0f), (floatn)(0.0f), (floatn)(0.0f), (floatn)(0.0f)};
            floatn known = (floatn)(0.0f), depth = (floatn)(0.0f);
#pragma unroll 1
            for (int r = 0; r < 2; r++)
                add_culled(color, &known, &depth, flat, flat_inv, slope, broad, size, ramps, x, y + r,
                           r ? lower : upper);
            pull_pixels(fill + to * 4, fill_inv + to, color[0], color[1], known.lo, depth.lo);
            pull_pixels(fill + (to + PIXELS) * 4, fill_inv + to + PIXELS, color[2], color[3], known.hi, depth.hi);
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
    for (int x = PIXELS * get_global_id(0); x < coarse.w; x += PIXELS * get_global_size(0)) {
        const size_t to = (size_t)coarse.x + (size_t)row * coarse.w + x;
        if (x >= coarse.y) { /* past the row */
            store_lanes(fill + to * 4, (floatn)(0.0f));
            store_part(fill_inv + to, (floatp)(EMPTY));
            continue;
        }
        const size_t top = (size_t)fine.x + (size_t)(2 * row) * fine.w + 2 * x;
        const size_t low = top + (has_low ? fine.w : 0);
        const float keep = has_low ? 1.0f : 0.0f;
        const floath upper = load_half(fill_inv + top), lower = has_low ? load_half(fill_inv + low) : (floath)(EMPTY);
        const floath in_upper = upper < 0.0f ? (floath)(0.0f) : (floath)(1.0f);
        const floath in_lower = lower < 0.0f ? (floath)(0.0f) : (floath)(1.0f);
        pull_pixels(fill + to * 4, fill_inv + to, load_lanes(fill + top * 4) + load_lanes(fill + low * 4) * keep,
                    load_lanes(fill + top * 4 + LANES) + load_lanes(fill + low * 4 + LANES) * keep,
                    in_upper + in_lower, in_upper * upper + in_lower * lower);
    }
}

/* Two rows of a coarser level that a finer row lies between, the nearer one first. */
typedef struct {
    size_t near, far; /* first pixel */
    int width;
} Between;

INLINE Between between(int4 level, int fine_row)
{
    const int near = clamp_index(fine_row >> 1, level.z - 1);
    const int far = clamp_index(fine_row & 1 ? near + 1 : near - 1, level.z - 1);
    Between rows = {(size_t)level.x + (size_t)near * level.w, (size_t)level.x + (size_t)far * level.w, level.y};
    return rows;
}

/* PIXELS pixels at x of a row; beyond its ends the row repeats its edge. */
INLINE floatn load_pixels_edge(const __global float *row, int x, int width)
{
    if (x >= 0 && x + PIXELS <= width) return load_lanes(row + x * 4);
#define EDGE_PIXEL(i) load_pixel(row + clamp_index(x + i, width - 1) * 4)
    return PIXELS_OF(EDGE_PIXEL);
#undef EDGE_PIXEL
}

INLINE floath load_half_edge(const __global float *row, int x, int width)
{
    if (x >= 0 && x + 2 * PIXELS <= width) return load_half(row + x);
    float v[2 * PIXELS];
#pragma unroll
    for (int t = 0; t < 2 * PIXELS; t++) v[t] = row[clamp_index(x + t, width - 1)];
    return *(const floath_unaligned *)v;
}

/* PIXELS values between rows, or twice as many of inverse depth. */
INLINE floatn mixed_rows(floatn near, floatn far) { return 0.75f * near + 0.25f * far; }
INLINE floath mixed_depths(floath near, floath far) { return 0.75f * near + 0.25f * far; }

/* Quadratic B-spline subdivision: the finer pixels over PIXELS coarser ones at x (weights 9, 3, 3, 1 of 16). */
INLINE void expand_pixels(floatn fine[2], const __global float *image, Between rows, int x)
{
    const __global float *near = image + rows.near * 4, *far = image + rows.far * 4;
    floatn left, mid, right;
    if (x > 0 && x + PIXELS < rows.width) {
        near += x * 4;
        far += x * 4;
        left = mixed_rows(load_lanes(near - 4), load_lanes(far - 4));
        mid = mixed_rows(load_lanes(near), load_lanes(far));
        right = mixed_rows(load_lanes(near + 4), load_lanes(far + 4));
    } else {
        left = mixed_rows(load_pixels_edge(near, x - 1, rows.width), load_pixels_edge(far, x - 1, rows.width));
        mid = mixed_rows(load_pixels_edge(near, x, rows.width), load_pixels_edge(far, x, rows.width));
        right = mixed_rows(load_pixels_edge(near, x + 1, rows.width), load_pixels_edge(far, x + 1, rows.width));
    }
    interleave_pixels(fine, 0.75f * mid + 0.25f * left, 0.75f * mid + 0.25f * right);
}

/* The same for inverse depth: LANES finer pixels. */
INLINE floatn expand_depth(const __global float *inv, Between rows, int x)
{
    const __global float *near = inv + rows.near, *far = inv + rows.far;
    const floath left =
        mixed_depths(load_half_edge(near, x - 1, rows.width), load_half_edge(far, x - 1, rows.width));
    const floath mid = mixed_depths(load_half_edge(near, x, rows.width), load_half_edge(far, x, rows.width));
    const floath right =
        mixed_depths(load_half_edge(near, x + 1, rows.width), load_half_edge(far, x + 1, rows.width));
    floatn fine;
    fine.even = 0.75f * mid + 0.25f * left;
    fine.odd = 0.75f * mid + 0.25f * right;
    return fine;
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
    for (int x = LANES * get_global_id(0); x < fine.y; x += LANES * get_global_size(0)) {
        const size_t to = (size_t)fine.x + (size_t)row * fine.w + x;
        floatn w = load_lanes(fill_inv + to);
        if (!any_lane(w < 0.0f)) continue;
        store_lanes(fill_inv + to, w < 0.0f ? expand_depth(fill_inv, rows, x / 2) : w);
        const floatp depth[4] = FOUR_PARTS(w);
#pragma unroll
        for (int h = 0; h < 2; h++) {
            if (least_part(depth[2 * h]) >= 0.0f && least_part(depth[2 * h + 1]) >= 0.0f) continue;
            floatn c[2];
            expand_pixels(c, fill, rows, x / 2 + PIXELS * h);
            __global float *at = fill + (to + 2 * PIXELS * h) * 4;
            store_lanes(at, spread_part(w, 2 * h) < 0.0f ? c[0] : load_lanes(at));
            store_lanes(at + LANES, spread_part(w, 2 * h + 1) < 0.0f ? c[1] : load_lanes(at + LANES));
        }
    }
}

/* Adds LANES pixels of a sub-image's level 0, culled, disoccluded and weighted, to `quad`. */
INLINE void add_mixed(floatn quad[4], const __global float *flat, const __global float *flat_inv,
                      const __global float *slope, const __global float *broad, const __global float *fill,
                      const __global float *fill_inv, int4 sub, int4 level, PyramidSize size, PyramidRamps ramps, int x,
                      int y, PyramidBlock block)
{
    const floatn zero = (floatn)(0.0f), one = (floatn)(1.0f);
    floatn open = one; /* what the sources so far let through */
    intn holes = (intn)(-1);
    for (int s = block.first; s < size.sources; s++) {
        const size_t at = ((size_t)s * size.height + y) * size.pitch + x;
        const floatn w = load_lanes(flat_inv + at);
        floatn weight = open * rise_of(w, s, at, slope, broad, ramps);
        const intn take = weight > 0.0f;
        if (!any_lane(take)) continue;
        holes = holes && !take;
#if PYRAMID_PAPER
        open = take ? zero : open;
#else
        /* A visible surface with a share of its weight lets through the next that is not culled. */
        open = take ? (s == 0 ? one - weight : zero) : open;
#endif
        weight *= matting_fall(w, ramps.ramp);
        if (any_lane(weight > 0.0f)) {
#pragma unroll
            for (int q = 0; q < 4; q++) quad[q] += load_lanes(flat + (at + PIXELS * q) * 4) * spread_part(weight, q);
        }
        if (!any_lane(open > 0.0f)) return;
    }
    if (!any_lane(holes)) return;
    const Between rows = between(level, y + sub.x);
    const floatn v = expand_depth(fill_inv, rows, (x + sub.x) / 2);
    const floatn filled = holes ? matting_rise(v, 0, 0, ramps) * matting_fall(v, ramps.ramp) : zero;
    if (!any_lane(filled > 0.0f)) return;
#pragma unroll 1 /* both at once take more registers than a GPU gives */
    for (int h = 0; h < 2; h++) {
        floatn c[2];
        expand_pixels(c, fill, rows, (x + sub.x) / 2 + PIXELS * h);
#pragma unroll
        for (int q = 0; q < 4; q++)
            if (q / 2 == h) quad[q] += c[q % 2] * spread_part(filled, q);
    }
}

/* The same for PYRAMID_RUN pixels. */
INLINE void add_matted(floatn sum[4 * PYRAMID_RUNS], const __global float *flat, const __global float *flat_inv,
                       const __global float *slope, const __global float *broad, const __global float *fill,
                       const __global float *fill_inv, int4 sub, int4 level, PyramidSize size, PyramidRamps ramps,
                       int x, int y, PyramidBlock block)
{
    if (block.kind == BLOCK_BEHIND) return;
    if (block.kind == BLOCK_PAST) {
        const size_t at = ((size_t)block.first * size.height + y) * size.pitch + x;
#pragma unroll
        for (int j = 0; j < PYRAMID_RUNS; j++) {
            const floatn weight = matting_fall(load_lanes(flat_inv + at + LANES * j), ramps.ramp);
#pragma unroll
            for (int q = 0; q < 4; q++)
                sum[4 * j + q] += load_lanes(flat + (at + LANES * j + PIXELS * q) * 4) * spread_part(weight, q);
        }
        return;
    }
    for (int j = 0; j < PYRAMID_RUNS; j++)
        add_mixed(sum + 4 * j, flat, flat_inv, slope, broad, fill, fill_inv, sub, level, size, ramps, x + LANES * j, y,
                  block);
}

/* --- blurring (section 3.4): 4x4 box analysis, quadratic B-spline synthesis --- */

/* Runs of PIXELS finer pixels that PIXELS coarser ones are made of, of which 2 * PIXELS + 2 pixels count. */
#define BOX_RUNS (LANES == 4 ? 4 : 3)

/* PIXELS coarser pixels: sums of four finer ones, two apart. */
INLINE floatn box_pixels(const floatn v[BOX_RUNS])
{
    const floatn pairs = even_pixels(v[0], v[1]) + odd_pixels(v[0], v[1]);
#if LANES == 16
    return pairs + (floatn)(pairs.s4567, pairs.s89ab, pairs.scdef, v[2].s0123 + v[2].s4567);
#elif LANES == 8
    return pairs + (floatn)(pairs.hi, v[2].lo + v[2].hi);
#else
    return pairs + (v[2] + v[3]);
#endif
}

INLINE float4 load_pixel_local(const __local float *p) { return *(const __local float4_unaligned *)p; }

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
                            const __global float *restrict broad, const __global float4 *restrict span,
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
            const int upper_y = clamp_index(2 * row - 1, sub.w - 1) - sub.x;
            const int lower_y = clamp_index(2 * row, sub.w - 1) - sub.x;
            for (int at = PYRAMID_RUN * lid; at < line_width; at += PYRAMID_RUN * items) {
                if (first + at < 0 || first + at >= sub.z) continue;
                const int x = first + at - sub.x;
                const PyramidBlock upper = block_of(span, size, ramps, x, upper_y);
                const PyramidBlock lower = block_of(span, size, ramps, x, lower_y);
                floatn sum[4 * PYRAMID_RUNS];
#pragma unroll
                for (int q = 0; q < 4 * PYRAMID_RUNS; q++) sum[q] = (floatn)(0.0f);
#pragma unroll 1
                for (int r = 0; r < 2; r++)
                    add_matted(sum, flat, flat_inv, slope, broad, fill, fill_inv, sub, level, size, ramps, x,
                               r ? lower_y : upper_y, r ? lower : upper);
#pragma unroll
                for (int q = 0; q < 4 * PYRAMID_RUNS; q++) store_lanes_local(line + (at + PIXELS * q) * 4, sum[q]);
            }
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        if (p > 0 && row >= 1 && row <= height) { /* row - 1 has both its pairs of rows now */
            const int end = x0 + segment < level.y ? x0 + segment : level.y;
            for (int x = x0 + PIXELS * lid; x < end; x += PIXELS * items) {
                const int at = 2 * x - 1 - first;
                floatn v[BOX_RUNS];
                if (x > 0 && 2 * x + 2 * PIXELS < sub.z) {
#pragma unroll
                    for (int t = 0; t < BOX_RUNS; t++) {
                        const int from = (at + PIXELS * t) * 4;
                        v[t] = load_lanes_local(line + from) + load_lanes_local(other + from);
                    }
                } else {
#pragma unroll
                    for (int t = 0; t < BOX_RUNS; t++) {
#define LINE_AT(j) ((clamp_index(2 * x - 1 + PIXELS * t + j, sub.z - 1) - first) * 4)
#define LINE_PIXEL(j) (load_pixel_local(line + LINE_AT(j)) + load_pixel_local(other + LINE_AT(j)))
                        v[t] = PIXELS_OF(LINE_PIXEL);
#undef LINE_PIXEL
#undef LINE_AT
                    }
                }
                store_lanes(blur + ((size_t)level.x + (size_t)(row - 1) * level.w + x) * 4, 0.0625f * box_pixels(v));
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
    for (int x = PIXELS * get_global_id(0); x < coarse.y; x += PIXELS * get_global_size(0)) {
        floatn v[BOX_RUNS];
#pragma unroll
        for (int t = 0; t < BOX_RUNS; t++) v[t] = (floatn)(0.0f);
        for (int j = 0; j < 4; j++) {
            const __global float *from =
                blur + ((size_t)fine.x + (size_t)clamp_index(2 * row - 1 + j, fine.z - 1) * fine.w) * 4;
#pragma unroll
            for (int t = 0; t < BOX_RUNS; t++) v[t] += load_pixels_edge(from, 2 * x - 1 + PIXELS * t, fine.y);
        }
        store_lanes(blur + ((size_t)coarse.x + (size_t)row * coarse.w + x) * 4, 0.0625f * box_pixels(v));
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
    for (int x = PIXELS * get_global_id(0); 2 * x < fine.y; x += PIXELS * get_global_size(0)) {
        floatn c[2];
        expand_pixels(c, blur, rows, x);
        store_lanes(to + 8 * x, c[0]);
        store_lanes(to + 8 * x + LANES, c[1]);
    }
}

/* --- blending (section 3.5) --- */

/* Divide PIXELS pixels by coverage and store them at the place the guard band leaves. */
INLINE void store_finished(__global float *out, floatn v, PyramidSize size, int x, int y)
{
    const int ox = x - size.guard, oy = y - size.guard;
    const int width = size.width - 2 * size.guard, height = size.height - 2 * size.guard;
    if (oy < 0 || oy >= height || ox <= -PIXELS || ox >= width) return;
    __global float *to = out + ((long)oy * width + ox) * 4;
#if PYRAMID_DIVIDE
    floatp coverage = v.ALPHA;
    floatp scale = coverage > PYRAMID_MIN_COVERAGE ? 1.0f / coverage : (floatp)(0.0f);
    v = v * spread(scale);
    v.ALPHA = scale > 0.0f ? (floatp)(1.0f) : (floatp)(0.0f);
#endif
#if PYRAMID_ALPHA == 1
#pragma unroll
    for (int i = 0; i < PIXELS; i++) {
        const float alpha = pixel_of(v, i).x;
        if (ox + i >= 0 && ox + i < width) to[4 * i + 3] = alpha > 1.0f ? 1.0f : alpha;
    }
#else
    if (ox >= 0 && ox + PIXELS <= width) {
        store_lanes(to, v);
    } else {
#pragma unroll
        for (int i = 0; i < PIXELS; i++)
            if (ox + i >= 0 && ox + i < width) store_pixel(to + 4 * i, pixel_of(v, i));
    }
#endif
}

/* pyramid_blend: expands level 1 of every sub-image and lays one over the other, nearest first (eqs. 14-15); crops the
 * guard band.
 * reads   blur  level 1 of sub-images with steps
 *         flat, flat_inv, slope, broad, span, fill, fill_inv  for the one in focus, which is not blurred
 *         table  int4[sub-images][PYRAMID_LEVELS]; matting  PyramidMatting
 * writes  out  float[height - 2*guard][width - 2*guard][4]
 * range   2-D: (items per row, height - 2*guard), any local size; an item takes every get_global_size(0)-th LANES
 *         pixels */
__kernel void pyramid_blend(__global float *restrict out, const __global float *restrict blur,
                            const __global float *restrict flat, const __global float *restrict flat_inv,
                            const __global float *restrict slope, const __global float *restrict broad,
                            const __global float4 *restrict span, const __global float *restrict fill,
                            const __global float *restrict fill_inv,
                            const __global int4 *restrict table,
                            const __global PyramidMatting *restrict matting, PyramidSize size, int count)
{
    const int y = size.guard + (int)get_global_id(1);
    for (int x = size.guard / PYRAMID_RUN * PYRAMID_RUN + PYRAMID_RUN * (int)get_global_id(0);
         x < size.width - size.guard; x += PYRAMID_RUN * (int)get_global_size(0)) {
        floatn sum[4 * PYRAMID_RUNS];
#pragma unroll
        for (int q = 0; q < 4 * PYRAMID_RUNS; q++) sum[q] = (floatn)(0.0f);
        for (int i = 0; i < count; i++) {
            const int4 sub = table[i * PYRAMID_LEVELS], level = table[i * PYRAMID_LEVELS + 1];
            floatn part[4 * PYRAMID_RUNS];
            if (sub.y == 0) {
                const PyramidRamps ramps = ramps_of(matting, i);
                const PyramidBlock block = block_of(span, size, ramps, x, y);
                if (block.kind == BLOCK_BEHIND) continue;
#pragma unroll
                for (int q = 0; q < 4 * PYRAMID_RUNS; q++) part[q] = (floatn)(0.0f);
                add_matted(part, flat, flat_inv, slope, broad, fill, fill_inv, sub, level, size, ramps, x, y, block);
            } else {
                const Between rows = between(level, y + sub.x);
#pragma unroll
                for (int j = 0; j < 2 * PYRAMID_RUNS; j++)
                    expand_pixels(part + 2 * j, blur, rows, (x + sub.x) / 2 + PIXELS * j);
            }
            floatn covered = (floatn)(1.0f);
#pragma unroll
            for (int q = 0; q < 4 * PYRAMID_RUNS; q++) {
                sum[q] = over(sum[q], part[q]);
                covered = lesser(covered, sum[q]);
            }
            if (least_pixel(covered).w >= 1.0f) break;
        }
#pragma unroll
        for (int q = 0; q < 4 * PYRAMID_RUNS; q++)
            if (x + PIXELS * q < size.width) store_finished(out, sum[q], size, x + PIXELS * q, y);
    }
}
