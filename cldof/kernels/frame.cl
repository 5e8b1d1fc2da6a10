/* frame.cl: what every method derives from a frame's layers once, before any lens is known. */

#include "frame.clh"

/* frame_inverse_depth: 1/z of every slot, in rows padded to a pitch; stats_tiles does the same on its way.
 * source  DESIGN section 2: the CoC is linear in inverse depth, and 0 stands for infinity without being an inf
 * reads   depth  float[peels][height][width]      m, inf = sky or nothing there
 *         color  float[peels][height][width][4]   tells what is there from what is not
 * writes  inv_depth  float[peels][height][pitch]  1/m, 0 = sky; `nothing` where nothing is there; EMPTY past the row
 * range   2-D, one item per row of a peel: (peels * height, 1), any local size */
__kernel void frame_inverse_depth(__global float *restrict inv_depth, const __global float *restrict depth,
                                  const __global float *restrict color, int width, int pitch, float nothing)
{
    const size_t row = get_global_id(0);
    const __global float *z = depth + row * width;
    const __global float *rgba = color + row * width * 4;
    for (int x = 0; x < pitch; x += FRAME_RUN)
        store_lanes(inv_depth + row * pitch + x, inverse_run(z + x, rgba + 4 * x, width - x, nothing));
}

/* frame_box: mean of blocks of pixels, the resolve of a supersampled image.
 * reads   image  float[factor * height][factor * width][4]
 * writes  out    float[height][width][4]
 * range   2-D, one item per FRAME_BOX_RUN pixels of a row of out, any local size */
#define FRAME_BOX_RUN 16
__kernel void frame_box(__global float *restrict out, const __global float *restrict image, int width, int height,
                        int factor)
{
    const int x0 = FRAME_BOX_RUN * (int)get_global_id(0), y = get_global_id(1);
    if (y >= height) return;
    const int x1 = x0 + FRAME_BOX_RUN < width ? x0 + FRAME_BOX_RUN : width;
    const size_t stride = (size_t)factor * width * 4;
    const float scale = 1.0f / (float)(factor * factor);
    for (int x = x0; x < x1; x++) {
        const __global float *block = image + (size_t)y * factor * stride + (size_t)x * factor * 4;
        float4 sum = (float4)(0.0f);
        for (int j = 0; j < factor; j++)
            for (int i = 0; i < factor; i++) sum += load_pixel(block + j * stride + i * 4);
        store_pixel(out + ((size_t)y * width + x) * 4, sum * scale);
    }
}

/* frame_middle: the pixel in the middle of each block, the resolve of a supersampled image with hard edges.
 * reads   image  float[factor * height][factor * width][4]; factor is odd
 * writes  out    float[height][width][4]
 * range   2-D, one item per FRAME_BOX_RUN pixels of a row of out, any local size */
__kernel void frame_middle(__global float *restrict out, const __global float *restrict image, int width, int height,
                           int factor)
{
    const int x0 = FRAME_BOX_RUN * (int)get_global_id(0), y = get_global_id(1);
    if (y >= height) return;
    const int x1 = x0 + FRAME_BOX_RUN < width ? x0 + FRAME_BOX_RUN : width;
    const size_t stride = (size_t)factor * width * 4;
    const __global float *row = image + ((size_t)y * factor + factor / 2) * stride + (size_t)(factor / 2) * 4;
    for (int x = x0; x < x1; x++)
        store_pixel(out + ((size_t)y * width + x) * 4, load_pixel(row + (size_t)x * factor * 4));
}
