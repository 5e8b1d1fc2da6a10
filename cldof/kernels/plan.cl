/* plan.cl: what the planner puts around a method: the pinhole image for all that is in focus, and windows of a frame to
 * blur by themselves.
 *
 * A window is a part of the frame, guard band included, that a method is run on as if it were a frame; the part of its
 * result that does not depend on what the window cut off goes into the image. */

/* The pinhole image is the one that numpy computes, to the bit. */
#pragma OPENCL FP_CONTRACT OFF

#include "common.clh"

typedef struct {
    int x, y;             /* of the window in the frame */
    int x0, y0, x1, y1;   /* what of the frame it decides */
} PlanWindow;

/* plan_pinhole: all peels composed without blur, back to front.
 * reads   color  float[peels][height][width][4]
 * writes  out    float[height - 2*guard][width - 2*guard][4]
 * range   1-D, one item per row of out, any local size */
__kernel void plan_pinhole(__global float *restrict out, const __global float *restrict color, int width, int height,
                           int peels, int guard)
{
    const int y = get_global_id(0), out_width = width - 2 * guard;
    if (y >= height - 2 * guard) return;
    const size_t peel = (size_t)height * width * 4;
    const __global float *row = color + ((size_t)(y + guard) * width + guard) * 4;
    __global float *to = out + (size_t)y * out_width * 4;
    for (int x = 0; x < out_width; x += PIXELS) {
        const int n = out_width - x;
        const __global float *at = row + x * 4;
        floatn image = load_pixels(at, n);
        /* Pixels past the end of the row hold nothing, which makes the last run of a row a long way round. */
        if (peels > 1 && least_lane(image.ALPHAS) != 1.0f) {
            image = (floatn)(0.0f);
            for (int m = peels - 1; m >= 0; m--) {
                const floatn c = load_pixels(at + m * peel, n);
                image = m == peels - 1 ? c : over(c, image);
            }
        }
        store_pixels(to + x * 4, image, n);
    }
}

/* plan_window: cut a window out of all peels of an input.
 * reads   from  float[peels][height][pitch][channels]
 * writes  to    float[peels][window_height][window_pitch][channels]  `fill` from window_width to window_pitch
 * range   2-D, one item per row of the window and peel, any local size */
__kernel void plan_window(__global float *restrict to, const __global float *restrict from, int pitch, int height,
                          int window_width, int window_pitch, int window_height, int channels, float fill,
                          PlanWindow window)
{
    const int y = get_global_id(0), m = get_global_id(1);
    if (y >= window_height) return;
    const __global float *source = from + (((size_t)m * height + window.y + y) * pitch + window.x) * channels;
    __global float *target = to + ((size_t)m * window_height + y) * window_pitch * channels;
    const int count = window_width * channels;
    int i = 0;
    for (; i + LANES <= count; i += LANES) store_lanes(target + i, load_lanes(source + i));
    for (; i < count; i++) target[i] = source[i];
    for (; i < window_pitch * channels; i++) target[i] = fill;
}

/* plan_paste: put what a window decides into the image.
 * reads   part   float[window_height][window_width][4]
 * updates image  float[height - 2*guard][width - 2*guard][4]
 * range   1-D, one item per row of the window, any local size */
__kernel void plan_paste(__global float *restrict image, const __global float *restrict part, int width, int height,
                         int guard, int window_width, int window_height, PlanWindow window)
{
    const int row = get_global_id(0), y = window.y + row;
    if (row >= window_height) return;
    const int out_width = width - 2 * guard;
    const int first = window.x0 > guard ? window.x0 : guard;
    const int end = window.x1 < width - guard ? window.x1 : width - guard;
    if (y < window.y0 || y >= window.y1 || y < guard || y >= height - guard) return;
    const __global float *from = part + ((size_t)row * window_width + first - window.x) * 4;
    __global float *to = image + ((size_t)(y - guard) * out_width + first - guard) * 4;
    int i = 0;
    for (; i + PIXELS <= end - first; i += PIXELS) store_lanes(to + 4 * i, load_lanes(from + 4 * i));
    for (; i < end - first; i++) store_pixel(to + 4 * i, load_pixel(from + 4 * i));
}
