/* gather.cl: depth of field by gathering around each pixel, the baseline that others are compared with.
 *
 * A pixel looks at samples of its own circle of confusion and averages those that could reach it. It sees neither what
 * is hidden nor how far nearer things spread over it. */

#include "common.clh"

/* 1: leave out samples in front that are too sharp to reach this far. 0: take all, whatever their depth. */
#ifndef GATHER_DEPTH_AWARE
#define GATHER_DEPTH_AWARE 1
#endif

typedef struct {
    int width, height, pitch; /* guard band included */
    int guard;
} GatherSize;

static inline float absolute(float v) { return v < 0.0f ? -v : v; }

/* Rounded before the pixel's place is added, so that it does not depend on that. */
static inline int nearest(float v) { return (int)(v + (v < 0.0f ? -0.5f : 0.5f)); }

/* gather_blur: mean over samples of the pixel's own CoC.
 * source  Potmesil & Chakravarty 1981 for the CoC; Scheuermann 2004, "Advanced Depth of Field", for leaving out sharp
 *         samples in front
 * reads   flat      float[height][pitch][4]  the pinhole image, premultiplied
 *         flat_inv  float[height][pitch]     1/m
 *         samples   float[count][3]          (x, y, distance from the middle) in CoC radii
 * writes  out  float[height - 2*guard][width - 2*guard][4]
 * scalars c1, c0  CoC radius in px = c1 / z + c0
 * range   2-D: (items per row, height - 2*guard), any local size; an item takes every get_global_size(0)-th pixel */
__kernel void gather_blur(__global float *restrict out, const __global float *restrict flat,
                          const __global float *restrict flat_inv, const __global float *restrict samples,
                          GatherSize size, int count, float c1, float c0)
{
    const int width = size.width - 2 * size.guard, y = size.guard + (int)get_global_id(1);
    for (int ox = get_global_id(0); ox < width; ox += get_global_size(0)) {
        const int x = ox + size.guard;
        const size_t at = (size_t)y * size.pitch + x;
        const float coc = c1 * flat_inv[at] + c0;
        const float radius = absolute(coc);
        float4 own = load_pixel(flat + at * 4), sum = (float4)(0.0f);
        float total = 0.0f;
        if (radius >= 0.5f) { /* else all samples are this pixel */
            for (int k = 0; k < count; k++) {
                int qx = clamp_index(x + nearest(radius * samples[3 * k]), size.width - 1);
                int qy = clamp_index(y + nearest(radius * samples[3 * k + 1]), size.height - 1);
                const size_t q = (size_t)qy * size.pitch + qx;
                float weight = 1.0f;
#if GATHER_DEPTH_AWARE
                float theirs = c1 * flat_inv[q] + c0;
                float reach = absolute(theirs) - radius * samples[3 * k + 2] + 1.0f;
                reach = reach < 0.0f ? 0.0f : reach;
                weight = theirs > coc || reach > 1.0f ? 1.0f : reach;
#endif
                sum += weight * load_pixel(flat + q * 4);
                total += weight;
            }
        }
        store_pixel(out + ((size_t)(y - size.guard) * width + ox) * 4, total > 1e-3f ? sum / total : own);
    }
}
