/* shading.cl: peels as they look from other points than the lens centre. */

#include "common.clh"
#include "shading.clh"

/* One value of 16 pixels, every stride floats; past the end of a row 0. */
static inline float16 shading_every(const __global float *p, int stride, int count)
{
    float v[16];
    for (int i = 0; i < 16; i++) v[i] = i < count ? p[i * stride] : 0.0f;
    return *(float16_unaligned *)v;
}

#define SHADING_PLANES 7

/* World positions of 16 pixels of a row, from (x, y) of the frame on. */
static inline Shading3 shading_run(const __global float4 *lighting, int x, int y, float16 inv_depth)
{
    const float16 lanes = (float16)(0.5f, 1.5f, 2.5f, 3.5f, 4.5f, 5.5f, 6.5f, 7.5f, 8.5f, 9.5f, 10.5f, 11.5f, 12.5f,
                                    13.5f, 14.5f, 15.5f);
    return shading_position(lighting, (float)x + lanes, (float16)((float)y + 0.5f), inv_depth);
}

/* Four pixels of what is mirrored, alpha 0. */
static inline float16 shading_quad(Shading3 light, int q)
{
    const float4 r[4] = {light.x.s0123, light.x.s4567, light.x.s89ab, light.x.scdef};
    const float4 g[4] = {light.y.s0123, light.y.s4567, light.y.s89ab, light.y.scdef};
    const float4 b[4] = {light.z.s0123, light.z.s4567, light.z.s89ab, light.z.scdef};
    const float4 x = r[q], y = g[q], z = b[q];
    return (float16)(x.x, y.x, z.x, 0.0f, x.y, y.y, z.y, 0.0f, x.z, y.z, z.z, 0.0f, x.w, y.w, z.w, 0.0f);
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
 * range   3-D, one item per 16 pixels of a row of a peel, any local size */
__kernel void shading_split(__global float *restrict matte, __global float *restrict surface,
                            const __global float *restrict color, const __global float *restrict inv_depth,
                            const __global float *restrict normal, const __global float *restrict specular,
                            const __global float *restrict shininess, const __global float4 *restrict lighting,
                            const __global float4 *restrict environment, int peels, int height, int width, int pitch)
{
    const int x = 16 * (int)get_global_id(0), y = get_global_id(1), m = get_global_id(2);
    if (x >= pitch || y >= height || m >= peels) return;
    const size_t row = (size_t)m * height + y, at = row * width + x;
    const int count = width - x < 16 ? width - x : 16;
    Shading3 n = shading_3(shading_every(normal + 3 * at, 3, count), shading_every(normal + 3 * at + 1, 3, count),
                           shading_every(normal + 3 * at + 2, 3, count));
    const shading_t square = shading_dot(n, n);
    const shading_t scale = square > 1e-12f ? shading_rsqrt(square) : (shading_t)(0.0f);
    n = shading_3(n.x * scale, n.y * scale, n.z * scale);
    const Shading3 f0 = shading_3(shading_every(specular + 3 * at, 3, count),
                                  shading_every(specular + 3 * at + 1, 3, count),
                                  shading_every(specular + 3 * at + 2, 3, count));
    const shading_t rough = shading_roughness(shading_every(shininess + at, 1, count));
    const float16 planes[SHADING_PLANES] = {n.x, n.y, n.z, f0.x, f0.y, f0.z, rough};
    __global float *out = surface + (((size_t)m * SHADING_PLANES * height) + y) * pitch + x;
    for (int p = 0; p < SHADING_PLANES; p++) store_quad(out + (size_t)p * height * pitch, planes[p]);

    Shading3 light = shading_3((shading_t)(0.0f), (shading_t)(0.0f), (shading_t)(0.0f));
    if (sum16(f0.x + f0.y + f0.z) > 0.0f) {
        const Shading3 position = shading_run(lighting, x, y, load_quad(inv_depth + row * pitch + x));
        light = shading_specular(position, n, f0, rough, lighting[7], lighting, environment);
    }
#pragma unroll
    for (int q = 0; q < 4; q++) {
        const int valid = count - 4 * q;
        if (valid <= 0) continue;
        const __global float *from = color + (at + 4 * q) * 4;
        const float16 c = valid >= 4 ? load_quad(from) : load_quad_part(from, valid);
        float16 rest = c - c.s33337777bbbbffff * shading_quad(light, q);
        store_quad_part(matte + (at + 4 * q) * 4, rest > 0.0f ? rest : (float16)(0.0f), valid);
    }
}

/* shading_view: the peels as a point of the lens sees them; the other way round than shading_split.
 * reads   matte, surface, inv_depth, lighting, environment  as shading_split has them
 * writes  view  float[peels][height][width][4]  premultiplied
 * scalars (right, up) of the point in units of the lens's radius, the radius in m
 * range   3-D, one item per 16 pixels of a row of a peel, any local size */
__kernel void shading_view(__global float *restrict view, const __global float *restrict matte,
                           const __global float *restrict surface, const __global float *restrict inv_depth,
                           const __global float4 *restrict lighting, const __global float4 *restrict environment,
                           int peels, int height, int width, int pitch, float right, float up, float radius)
{
    const int x = 16 * (int)get_global_id(0), y = get_global_id(1), m = get_global_id(2);
    if (x >= width || y >= height || m >= peels) return;
    const size_t row = (size_t)m * height + y, at = row * width + x, plane = (size_t)height * pitch;
    const int count = width - x < 16 ? width - x : 16;
    const __global float *p = surface + (size_t)m * SHADING_PLANES * plane + (size_t)y * pitch + x;
    const Shading3 f0 = shading_3(load_quad(p + 3 * plane), load_quad(p + 4 * plane), load_quad(p + 5 * plane));
    Shading3 light = shading_3((shading_t)(0.0f), (shading_t)(0.0f), (shading_t)(0.0f));
    if (sum16(f0.x + f0.y + f0.z) > 0.0f) {
        const Shading3 n = shading_3(load_quad(p), load_quad(p + plane), load_quad(p + 2 * plane));
        const Shading3 position = shading_run(lighting, x, y, load_quad(inv_depth + row * pitch + x));
        light = shading_specular(position, n, f0, load_quad(p + 6 * plane),
                                 shading_eye(lighting, right * radius, up * radius), lighting, environment);
    }
#pragma unroll
    for (int q = 0; q < 4; q++) {
        const int valid = count - 4 * q;
        if (valid <= 0) continue;
        const __global float *from = matte + (at + 4 * q) * 4;
        const float16 c = valid >= 4 ? load_quad(from) : load_quad_part(from, valid);
        store_quad_part(view + (at + 4 * q) * 4, c + c.s33337777bbbbffff * shading_quad(light, q), valid);
    }
}
