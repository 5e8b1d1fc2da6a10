/* gather.cl: depth of field by gathering around each pixel, the baseline that others are compared with.
 *
 * A pixel looks at taps of its own circle of confusion and averages those that could reach it. It sees neither what is
 * hidden nor how far nearer things spread over it. Taps stand at whole pixels, and a list of them serves a step of radii
 * within which their weights change evenly, so that the image changes evenly with the lens. */

#include "common.clh"

/* 1: leave out taps in front that are too sharp to reach this far. 0: take all, whatever their depth. */
#ifndef GATHER_DEPTH_AWARE
#define GATHER_DEPTH_AWARE 1
#endif

/* A step is an eighth of an octave of radii, from 0.5 px on: the top bits of a float, the rest of which says how far
 * into the step a radius is. */
#define STEP_BITS 20
#define FIRST_STEP (0x3f000000 >> STEP_BITS)

typedef struct {
    int width, height, pitch; /* guard band included */
    int guard;
} GatherSize;

typedef struct {
    int dx, dy;
    float distance;       /* px from the middle */
    float weight, change; /* at the least radius of a step; from there to its greatest */
} GatherTap;

static inline int greatest_int(intn v)
{
#if LANES == 16
    const int8 eight = v.lo > v.hi ? v.lo : v.hi;
    const int4 b = eight.lo > eight.hi ? eight.lo : eight.hi;
#elif LANES == 8
    const int4 b = v.lo > v.hi ? v.lo : v.hi;
#else
    const int4 b = v;
#endif
    const int2 c = b.lo > b.hi ? b.lo : b.hi;
    return c.x > c.y ? c.x : c.y;
}

/* LANES values of a row, which holds all of them if `is_inside`, else its ends repeat. */
static inline floatn values_at(const __global float *row, int x, int last, int is_inside)
{
    if (is_inside) return load_lanes(row + x);
    float v[LANES];
#pragma unroll
    for (int i = 0; i < LANES; i++) v[i] = row[clamp_index(x + i, last)];
    return load_lanes_private(v);
}

/* The same for PIXELS pixels. */
static inline floatn pixels_at(const __global float *row, int x, int last, int is_inside)
{
    if (is_inside) return load_lanes(row + 4 * x);
#define EDGE_PIXEL(i) load_pixel(row + 4 * clamp_index(x + i, last))
    return PIXELS_OF(EDGE_PIXEL);
#undef EDGE_PIXEL
}

/* gather_blur: mean over taps of the pixel's own CoC.
 * source  Potmesil & Chakravarty 1981 for the CoC; Scheuermann 2004, "Advanced Depth of Field", for leaving out sharp
 *         samples in front
 * reads   flat      float[height][pitch][4]  the pinhole image, premultiplied
 *         flat_inv  float[height][pitch]     1/m
 *         taps      GatherTap[]              step after step
 *         first     int[steps + 1]           where each step's taps begin
 * writes  out  float[height - 2*guard][width - 2*guard][4]
 * scalars last  the greatest radius that there are taps for, px; c1, c0  CoC radius in px = c1 / z + c0
 * range   2-D: (items per row, height - 2*guard), any local size; an item takes every get_global_size(0)-th LANES
 *         pixels */
__kernel void gather_blur(__global float *restrict out, const __global float *restrict flat,
                          const __global float *restrict flat_inv, const __global GatherTap *restrict taps,
                          const __global int *restrict first, GatherSize size, float last, float c1, float c0)
{
    const floatn zero = (floatn)(0.0f), one = (floatn)(1.0f);
    const int width = size.width - 2 * size.guard, y = size.guard + (int)get_global_id(1), end = size.width - 1;
    for (int ox = LANES * get_global_id(0); ox < width; ox += LANES * get_global_size(0)) {
        const int x = ox + size.guard;
        const size_t row = (size_t)y * size.pitch;
        const int is_whole = x + LANES - 1 <= end;
        const floatn coc = c1 * values_at(flat_inv + row, x, end, is_whole) + c0;
        const floatn radius = lesser(absolute(coc), (floatn)(last));
        const floatn within = to_floatn(as_intn(radius) & ((1 << STEP_BITS) - 1)) * (1.0f / (1 << STEP_BITS));
        intn step = (as_intn(radius) >> STEP_BITS) - FIRST_STEP; /* below 0: in focus, and all of this pixel is its own */
        floatn sum[4] = {zero, zero, zero, zero}, total = zero;
        for (;;) { /* mostly once: neighbours are blurred alike */
            const int now = greatest_int(step);
            if (now < 0) break;
            const floatn mine = step == now ? one : zero;
            const floatn part = mine * within;
            step = step == now ? (intn)(-1) : step;
            for (int k = first[now]; k < first[now + 1]; k++) {
                const GatherTap tap = taps[k];
                const size_t there = (size_t)clamp_index(y + tap.dy, size.height - 1) * size.pitch;
                const int at = x + tap.dx, is_inside = at >= 0 && at + LANES - 1 <= end;
                floatn weight = mine * tap.weight + part * tap.change;
#if GATHER_DEPTH_AWARE
                const floatn theirs = c1 * values_at(flat_inv + there, at, end, is_inside) + c0;
                floatn reach = absolute(theirs) + 1.0f - lesser((floatn)(tap.distance), radius); /* rims are soft */
                reach = lesser(greater(reach, zero), one);
                weight *= theirs > coc ? one : reach;
#endif
#pragma unroll
                for (int q = 0; q < 4; q++)
                    sum[q] += spread_part(weight, q) * pixels_at(flat + there * 4, at + PIXELS * q, end, is_inside);
                total += weight;
            }
        }
#pragma unroll
        for (int q = 0; q < 4; q++) {
            const int n = width - ox - PIXELS * q;
            if (n <= 0) break;
            const floatn own = pixels_at(flat + row * 4, x + PIXELS * q, end, is_whole);
            const floatn weights = spread_part(total, q); /* not 0 where there are taps: one is the pixel itself */
            store_pixels(out + ((size_t)(y - size.guard) * width + ox + PIXELS * q) * 4,
                         weights > 0.0f ? sum[q] / weights : own, n);
        }
    }
}
