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

/* Four pixels of a row, whose ends repeat. */
static inline float4 four_values(const __global float *row, int x, int last)
{
    if (x >= 0 && x + 3 <= last) return load_pixel(row + x);
    return (float4)(row[clamp_index(x, last)], row[clamp_index(x + 1, last)], row[clamp_index(x + 2, last)],
                    row[clamp_index(x + 3, last)]);
}

static inline float16 four_pixels(const __global float *row, int x, int last)
{
    if (x >= 0 && x + 3 <= last) return load_quad(row + 4 * x);
    return (float16)(load_pixel(row + 4 * clamp_index(x, last)), load_pixel(row + 4 * clamp_index(x + 1, last)),
                     load_pixel(row + 4 * clamp_index(x + 2, last)), load_pixel(row + 4 * clamp_index(x + 3, last)));
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
 * range   2-D: (items per row, height - 2*guard), any local size; an item takes every get_global_size(0)-th four pixels */
__kernel void gather_blur(__global float *restrict out, const __global float *restrict flat,
                          const __global float *restrict flat_inv, const __global GatherTap *restrict taps,
                          const __global int *restrict first, GatherSize size, float last, float c1, float c0)
{
    const int width = size.width - 2 * size.guard, y = size.guard + (int)get_global_id(1), end = size.width - 1;
    for (int ox = 4 * get_global_id(0); ox < width; ox += 4 * get_global_size(0)) {
        const int x = ox + size.guard;
        const size_t row = (size_t)y * size.pitch;
        const float4 coc = c1 * four_values(flat_inv + row, x, end) + c0;
        float4 radius = coc < 0.0f ? -coc : coc;
        radius = radius < last ? radius : last;
        const float4 within = convert_float4(as_int4(radius) & ((1 << STEP_BITS) - 1)) * (1.0f / (1 << STEP_BITS));
        int4 step = (as_int4(radius) >> STEP_BITS) - FIRST_STEP; /* below 0: in focus, and all of this pixel is its own */
        const float16 own = four_pixels(flat + row * 4, x, end);
        float16 sum = 0.0f;
        float4 total = 0.0f;
        for (;;) { /* mostly once: neighbours are blurred alike */
            const int2 pair = step.lo > step.hi ? step.lo : step.hi;
            const int now = pair.x > pair.y ? pair.x : pair.y;
            if (now < 0) break;
            const float4 mine = step == now ? (float4)(1.0f) : (float4)(0.0f);
            const float4 part = mine * within;
            step = step == now ? (int4)(-1) : step;
            for (int k = first[now]; k < first[now + 1]; k++) {
                const GatherTap tap = taps[k];
                const size_t there = (size_t)clamp_index(y + tap.dy, size.height - 1) * size.pitch;
                float4 weight = mine * tap.weight + part * tap.change;
#if GATHER_DEPTH_AWARE
                const float4 theirs = c1 * four_values(flat_inv + there, x + tap.dx, end) + c0;
                float4 reach = (theirs < 0.0f ? -theirs : theirs) + 1.0f;
                reach -= tap.distance < radius ? (float4)(tap.distance) : radius; /* rims are soft */
                reach = reach < 0.0f ? (float4)(0.0f) : reach;
                weight *= theirs > coc || reach > 1.0f ? (float4)(1.0f) : reach;
#endif
                sum += spread(weight) * four_pixels(flat + there * 4, x + tap.dx, end);
                total += weight;
            }
        }
        const float16 weights = spread(total); /* not 0 where there are taps: one is the pixel itself */
        store_quad_part(out + ((size_t)(y - size.guard) * width + ox) * 4, weights > 0.0f ? sum / weights : own,
                        width - ox);
    }
}
