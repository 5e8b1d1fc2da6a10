/* shading.cl: peels as they look from other points than the lens centre. */

#include "common.clh"
#include "shading.clh"

/* One value of LANES pixels, every stride floats; past the end of a row 0. */
static inline floatn shading_every(const __global float *p, int stride, int count)
{
    float v[LANES];
    for (int i = 0; i < LANES; i++) v[i] = i < count ? p[i * stride] : 0.0f;
    return load_lanes_private(v);
}

#define SHADING_PLANES 7

/* World positions of LANES pixels of a row, from (x, y) of the frame on. */
static inline Shading3 shading_run(const __global float4 *lighting, int x, int y, floatn inv_depth)
{
    return shading_position(lighting, (float)x + (to_floatn(LANE_INDEX) + 0.5f), (floatn)((float)y + 0.5f), inv_depth);
}

/* PIXELS pixels of what is mirrored, alpha 0. */
static inline floatn shading_pixels(Shading3 light, int q)
{
    const floatp r[4] = FOUR_PARTS(light.x), g[4] = FOUR_PARTS(light.y), b[4] = FOUR_PARTS(light.z);
    floatn pixels = (floatn)(0.0f);
    pixels.RED = r[q], pixels.GREEN = g[q], pixels.BLUE = b[q];
    return pixels;
}

/* shading_split: colour without what surfaces mirror towards the lens centre, and the surfaces as planes.
 * Slots that mirror nothing keep their colour to the bit.
 * reads   color      float[peels][height][width][4]  premultiplied
 *         inv_depth  float[peels][height][pitch]     1/m
 *         normal, specular  float[peels][height][width][3]
 *         shininess  float[peels][height][width]     Phong exponent
 *         lighting, environment  see shading.clh
 * writes  matte      float[peels][height][width][4]  premultiplied
 *         surface    float[peels][SHADING_PLANES][height][pitch]  unit normal, specular, roughness
 * range   3-D, one item per LANES pixels of a row of a peel, any local size */
__kernel void shading_split(__global float *restrict matte, __global float *restrict surface,
                            const __global float *restrict color, const __global float *restrict inv_depth,
                            const __global float *restrict normal, const __global float *restrict specular,
                            const __global float *restrict shininess, const __global float4 *restrict lighting,
                            const __global float4 *restrict environment, int peels, int height, int width, int pitch)
{
    const int x = LANES * (int)get_global_id(0), y = get_global_id(1), m = get_global_id(2);
    if (x >= pitch || y >= height || m >= peels) return;
    const size_t row = (size_t)m * height + y, at = row * width + x;
    const int count = width - x < LANES ? width - x : LANES;
    Shading3 n = shading_3(shading_every(normal + 3 * at, 3, count), shading_every(normal + 3 * at + 1, 3, count),
                           shading_every(normal + 3 * at + 2, 3, count));
    const floatn square = shading_dot(n, n);
    const floatn scale = square > 1e-12f ? shading_rsqrt(square) : (floatn)(0.0f);
    n = shading_3(n.x * scale, n.y * scale, n.z * scale);
    const Shading3 f0 = shading_3(shading_every(specular + 3 * at, 3, count),
                                  shading_every(specular + 3 * at + 1, 3, count),
                                  shading_every(specular + 3 * at + 2, 3, count));
    const floatn rough = shading_roughness(shading_every(shininess + at, 1, count));
    const floatn planes[SHADING_PLANES] = {n.x, n.y, n.z, f0.x, f0.y, f0.z, rough};
    __global float *out = surface + (((size_t)m * SHADING_PLANES * height) + y) * pitch + x;
    for (int p = 0; p < SHADING_PLANES; p++) store_lanes(out + (size_t)p * height * pitch, planes[p]);

    Shading3 light = shading_3((floatn)(0.0f), (floatn)(0.0f), (floatn)(0.0f));
    if (sum_lanes(f0.x + f0.y + f0.z) > 0.0f) {
        const Shading3 position = shading_run(lighting, x, y, load_lanes(inv_depth + row * pitch + x));
        light = shading_specular(position, n, f0, rough, lighting[7], lighting, environment);
    }
#pragma unroll
    for (int q = 0; q < 4; q++) {
        const int valid = count - PIXELS * q;
        if (valid <= 0) continue;
        const __global float *from = color + (at + PIXELS * q) * 4;
        const floatn c = load_pixels(from, valid);
        floatn rest = c - c.ALPHAS * shading_pixels(light, q);
        store_pixels(matte + (at + PIXELS * q) * 4, rest > 0.0f ? rest : (floatn)(0.0f), valid);
    }
}

/* shading_view: the peels as a point of the lens sees them; the other way round than shading_split.
 * reads   matte, surface, inv_depth, lighting, environment  as shading_split has them
 * writes  view  float[peels][height][width][4]  premultiplied
 * scalars (right, up) of the point in units of the lens's radius, the radius in m
 * range   3-D, one item per LANES pixels of a row of a peel, any local size */
__kernel void shading_view(__global float *restrict view, const __global float *restrict matte,
                           const __global float *restrict surface, const __global float *restrict inv_depth,
                           const __global float4 *restrict lighting, const __global float4 *restrict environment,
                           int peels, int height, int width, int pitch, float right, float up, float radius)
{
    const int x = LANES * (int)get_global_id(0), y = get_global_id(1), m = get_global_id(2);
    if (x >= width || y >= height || m >= peels) return;
    const size_t row = (size_t)m * height + y, at = row * width + x, plane = (size_t)height * pitch;
    const int count = width - x < LANES ? width - x : LANES;
    const __global float *p = surface + (size_t)m * SHADING_PLANES * plane + (size_t)y * pitch + x;
    const Shading3 f0 = shading_3(load_lanes(p + 3 * plane), load_lanes(p + 4 * plane), load_lanes(p + 5 * plane));
    Shading3 light = shading_3((floatn)(0.0f), (floatn)(0.0f), (floatn)(0.0f));
    if (sum_lanes(f0.x + f0.y + f0.z) > 0.0f) {
        const Shading3 n = shading_3(load_lanes(p), load_lanes(p + plane), load_lanes(p + 2 * plane));
        const Shading3 position = shading_run(lighting, x, y, load_lanes(inv_depth + row * pitch + x));
        light = shading_specular(position, n, f0, load_lanes(p + 6 * plane),
                                 shading_eye(lighting, right * radius, up * radius), lighting, environment);
    }
#pragma unroll
    for (int q = 0; q < 4; q++) {
        const int valid = count - PIXELS * q;
        if (valid <= 0) continue;
        const __global float *from = matte + (at + PIXELS * q) * 4;
        const floatn c = load_pixels(from, valid);
        store_pixels(view + (at + PIXELS * q) * 4, c + c.ALPHAS * shading_pixels(light, q), valid);
    }
}
